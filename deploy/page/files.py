"""The page's files, read once at the start: nothing on the disk can be reached through the server."""

from __future__ import annotations

from importlib.resources import files

FILES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
    ".svg": "image/svg+xml",
}
"""Content type by suffix; other files are not served."""
SECURITY = {
    # only this server's own files, no code or style in the page itself, no frame around it
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; worker-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def load_files(setup: bytes) -> dict[str, tuple[str, bytes]]:
    """Return type and content of each file by its path; `/setup.json` is `setup`."""
    found = {"/setup.json": (FILES[".json"], setup)} | read_static_files("deploy.page")
    found["/"] = found["/index.html"]
    return found


def read_static_files(package: str) -> dict[str, tuple[str, bytes]]:
    """Return type and content of each file in the folder `static` of a package, by its path."""
    found = {}
    for entry in files(package).joinpath("static").iterdir():
        kind = FILES.get("." + entry.name.rpartition(".")[2])
        if kind and entry.is_file():
            found[f"/{entry.name}"] = (kind, entry.read_bytes())
    return found
