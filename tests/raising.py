"""How a test says what is refused: by the error's code and the names and numbers in its sentence, whatever its words."""

from __future__ import annotations

import pytest

from tau_dyn.exceptions import TauDynError


def raises_code(code: str, *names: str) -> pytest.RaisesExc[TauDynError]:
    """Return the context in which an error with this code is raised whose sentence holds these names."""

    def agrees(fault: TauDynError) -> bool:
        missing = [name for name in names if name not in str(fault)]
        assert fault.code == code and not missing, f"not {code} with {missing}: {fault} [{fault.code}]"
        return True

    return pytest.raises(TauDynError, check=agrees)
