"""`brokk mode=list`: every registry, one line per option."""

from brokk_rl import registry
from brokk_rl.console_table import print_text
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
        width = max(len(option.name) for option in options)
        for group in [wanted] if wanted else groups:
            print_text(group, "bold")
            for option in options:
                if option.group == group:
                    origin = "" if option.package == registry.CORE else f" ({option.package})"
                    print_text(f"  {option.name:<{width}}  {option.summary()}{origin}")
