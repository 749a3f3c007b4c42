"""What mkdocstrings shows of a package: the names of its stub, which the package itself loads on first use."""

from typing import Any

import griffe


class StubNames(griffe.Extension):
    """Takes the names that a package's stub imports from its modules for the package's public names."""

    def on_package(self, *, pkg: griffe.Module, loader: griffe.GriffeLoader, **kwargs: Any) -> None:
        """Set what each package exports."""
        for package in [pkg, *(m for m in pkg.modules.values() if m.is_init_module)]:
            if "attach_stub" in package.members:
                package.exports = [
                    name
                    for name, member in package.members.items()
                    if member.is_alias and member.target_path.startswith(f"{package.path}.")
                ]
