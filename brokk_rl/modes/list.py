"""`brokk mode=list`: every registry, one line per entry."""

from rich.console import Console
from rich.table import Table

from brokk_rl import registry
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.spec import spec


@spec
class ListSelection:
    """What to list.

    Attributes:
        group: Only this group; `None` lists all of them.
    """

    group: str | None


@spec
class ListOptions:
    """Prints the options of every config group, those of installed extensions too."""

    list: ListSelection

    def run(self) -> None:
        """Prints the list."""
        entries = registry.list_options()
        groups = sorted({option.group for option in entries})
        if self.list.group and self.list.group not in groups:
            raise ConfigError(
                f"list.group: there is no group '{self.list.group}'; {list_choices(self.list.group, groups)}"
            )
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        table.add_column(no_wrap=True)
        table.add_column()
        for group in [self.list.group] if self.list.group else groups:
            table.add_row(f"[bold]{group}[/bold]", "")
            for option in entries:
                if option.group == group:
                    origin = (
                        "" if option.package == registry.CORE else f" [dim]({option.package})[/dim]"
                    )
                    table.add_row(f"  {option.name}", option.summary() + origin)
        Console().print(table)
