"""Extensions: config folders of other packages, appended to Hydra's search path.

A package offers options by one entry point, `[project.entry-points."brokk_rl.conf"] mine = "mine.conf"`. Importing this module does
nothing; the command calls `register`.
"""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from brokk_rl import registry


class Extensions(SearchPathPlugin):
    """Appends the config package of every installed extension."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Called by Hydra while it looks for the configuration."""
        for package in registry.packages():
            if package != registry.CORE:
                search_path.append(provider=package, path=f"pkg://{package}")


def register() -> None:
    """Makes the options of installed extensions known to Hydra.

    Raises:
        ConfigError: Two packages offer the same option; Hydra itself would silently take the first.
    """
    registry.options()
    Plugins.instance().register(Extensions)
