"""What counts as shown: words alike, numbers to the digits shown, dots for the rest; and what does not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from page_blocks import commands, steps
from page_replay import Played
from page_shown import differences

CAME = """
  The model predicts held-out force to 0.4649 %.

  plate_link.mass    10.105 ± 0.071   kg
  cart1            ███████▋             0.34 %
  offset −1.2e-05
"""


@pytest.mark.parametrize(
    "shown",
    [
        CAME,
        "The model predicts held-out force to 0.46 %.\n...",
        "...\nplate_link.mass 10.10 ± 0.07 kg\ncart1 ████ 0.34 %\n...",
        "The model predicts ...\n...\n...offset −1.2e-05",
        "...",
        "...\noffset −1.3e-05",
    ],
)
def test_it_is_as_shown(shown):
    """Gaps, bars, left-out lines and further digits make no difference."""
    assert differences(shown, CAME) == ""


@pytest.mark.parametrize(
    "shown",
    [
        "The model predicts held-out force to 0.48 %.\n...",
        "The model predicts held-out force to 0.46 %.",
        "...\nplate_link.mass 10.15 ± 0.07 kg\n...",
        "...\nplate_link.mass 10.105 ± 0.071 N\n...",
        "...\ncart2 ████ 0.34 %\n...",
        "...\noffset −1.2e-06",
        f"{CAME}\nand more",
        "",
    ],
)
def test_it_is_not_as_shown(shown):
    """Another number, unit or name, a line too many or too few is seen and both sides are named."""
    assert "shown:" in differences(shown, CAME) and "came:" in differences(shown, CAME)


PAGE = """
```yaml title="a.yaml"
x: 1
```

```bash
tau-dyn check a.csv \\
    --json b.json   # and so on
```

```text
error: no
```

```sh
never run
```

```python
print(1)
```

Words in between.

```text
not what appeared
```
"""


def test_a_page_is_read_as_steps():
    """Titles are files, `bash` and `python` are done, `text` right behind them is what appears, `sh` is for reading."""
    first, second, third = steps(PAGE)
    assert (first.block.title, first.block.text, first.shown) == ("a.yaml", "x: 1\n", None)
    assert commands(second.block.text) == ["tau-dyn check a.csv --json b.json"]
    assert second.shown is not None and second.shown.text == "error: no\n"
    assert third.block.language == "python" and third.shown is None


@pytest.mark.parametrize("status, came, good", [(2, "error: no\n", True), (0, "", False), (2, "error: yes\n", False)])
def test_a_refusal_counts_where_it_is_shown(status, came, good):
    """A command may be refused if the page shows the refusal; then it must be, in these words."""
    assert (Played(steps(PAGE)[1], status, came, 0.0).fault == "") is good
    assert Played(steps(PAGE)[2], status, came, 0.0).fault == ("" if status == 0 else f"ended with status 2:\n{came}")
