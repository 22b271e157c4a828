"""`brokk mode=new`: writes a package of one's own, with an example of each part and its tests."""

import keyword
import re
import sys
import tempfile
from importlib import util
from pathlib import Path

from rich.console import Console

from brokk_rl.errors import ConfigError, StorageError
from brokk_rl.spec import spec

TEMPLATE = Path(__file__).parents[1] / "package_template"
TEMPLATE_NAME = "mine"
"""Name of the package in the template's files and folders."""
SUFFIX = ".txt"
"""Ends the names of the template's Python files, which are not modules of this package."""


@spec
class PackageRequest:
    """Name and place of a new package.

    Attributes:
        name: Import name of the package.
        folder: Folder into which the project `<name>` is written.
    """

    name: str
    folder: str

    def check(self) -> None:
        if not re.fullmatch("[a-z][a-z0-9_]*", self.name) or keyword.iskeyword(self.name):
            raise ConfigError(
                f"new.name: expected a Python package name such as 'my_brokk', got '{self.name}'"
            )
        if (Path(self.folder) / self.name).exists():
            raise ConfigError(
                f"new.name={self.name}: {Path(self.folder) / self.name} exists already; choose "
                "another name or new.folder=<folder>"
            )
        if self.name in sys.stdlib_module_names or util.find_spec(self.name):
            raise ConfigError(
                f"new.name={self.name}: a package of that name is installed already; choose another"
            )


@spec
class NewPackage:
    """Write a package with machine, tasks, actuator, effect, finder and their tests."""

    new: PackageRequest

    def run(self) -> None:
        """Write the project and print the next commands.

        Raises:
            StorageError: The folder cannot be written; nothing is left behind.
        """
        name, folder = self.new.name, Path(self.new.folder) / self.new.name
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent) as draft:
                project = Path(draft) / name
                for source in sorted(TEMPLATE.rglob("*.*")):
                    place = str(source.relative_to(TEMPLATE)).removesuffix(SUFFIX)
                    target = project / _rename(place, name)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_text(_rename(source.read_text(), name))
                project.rename(folder)
        except OSError as error:
            raise StorageError(
                f"cannot write {folder}: {error.strerror}; choose new.folder=<folder>"
            ) from error
        Console(highlight=False).print(
            f"{folder} holds a machine, two tasks, an actuator, an effect, a finder and their tests.\n"
            f"  pip install -e {folder}\n"
            f"  python -m pytest {folder / 'tests'}\n"
            "  brokk mode=check machine=two_links task=trace actuator=rubber",
            soft_wrap=True,
        )


def _rename(text: str, name: str) -> str:
    """Return a text of the template with the name of the new package."""
    return re.sub(rf"\b{TEMPLATE_NAME}\b", name, text)
