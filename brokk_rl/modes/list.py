"""`brokk mode=list`: every registry, one line per option."""

from rich.console import Console
from rich.markup import escape

from brokk_rl import registry
from brokk_rl.errors import ConfigError, list_choices
from brokk_rl.spec import spec


@spec
class ListSelection:
    """Selection of groups.

    Attributes:
        group: Only this group; `None` lists all of them.
    """

    group: str | None


@spec
class ListOptions:
    """List the options of every config group, one line each."""

    list: ListSelection

    def run(self) -> None:
        """Print the list; a line of an option is never cut.

        Raises:
            ConfigError: There is no such group.
        """
        options = registry.list_options()
        groups = sorted({option.group for option in options})
        wanted = self.list.group
        if wanted and wanted not in groups:
            raise ConfigError(
                f"list.group: there is no group '{wanted}'; {list_choices(wanted, groups)}"
            )
        console = Console(highlight=False)
        width = max(len(option.name) for option in options)
        for group in [wanted] if wanted else groups:
            console.print(f"[bold]{escape(group)}[/bold]")
            for option in options:
                if option.group != group:
                    continue
                own = option.package == registry.CORE
                origin = "" if own else f" [dim]({escape(option.package)})[/dim]"
                line = f"  {option.name:<{width}}  {escape(option.summary())}{origin}"
                # a text that is cut loses its end without a trace: the terminal may wrap it instead
                console.print(line, soft_wrap=True)
