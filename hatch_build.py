"""What PyPI shows beyond pyproject.toml: the links of the project, and the README with links that
lead somewhere from there.

Both follow from one line, `repository` in `[tool.hatch.metadata.hooks.custom]`. While it is empty
the package has no links, and its README is the file as it stands.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURES = (".png", ".webp", ".svg", ".gif")
RELATIVE_LINK = re.compile(r"(?<=\]\()(?!https?:|#|mailto:)([^)\s]+)")


class ProjectLinks(MetadataHookInterface):
    """Fills in the dynamic fields `urls` and `readme`."""

    def update(self, metadata: dict[str, Any]) -> None:
        root = Path(self.root)
        repository = str(self.config.get("repository", "")).rstrip("/")
        version = re.search(
            r'^__version__ = "(.+)"$',
            (root / "wasp_cli" / "__init__.py").read_text(encoding="utf-8"),
            re.MULTILINE,
        )
        if version is None:
            raise ValueError("wasp_cli/__init__.py has no line `__version__ = ...`")
        tag = f"v{version[1]}"
        metadata["urls"] = project_urls(repository, tag) if repository else {}
        text = (root / "README.md").read_text(encoding="utf-8")
        if repository:
            text = with_absolute_links(text, repository, tag)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def project_urls(repository: str, tag: str) -> dict[str, str]:
    """Return the links beside the description, by the names that PyPI has icons for."""
    return {
        "Repository": repository,
        "Documentation": f"{repository}/blob/{tag}/README.md#where-to-read-on",
        "Changelog": f"{repository}/blob/{tag}/CHANGELOG.md",
        "Issues": f"{repository}/issues",
    }


def with_absolute_links(text: str, repository: str, tag: str) -> str:
    """Return Markdown whose relative links lead into the repository at a tag; pictures to the
    files themselves.
    """

    def absolute(link: re.Match[str]) -> str:
        view = "raw" if link[1].endswith(PICTURES) else "blob"
        return f"{repository}/{view}/{tag}/{link[1]}"

    return RELATIVE_LINK.sub(absolute, text)
