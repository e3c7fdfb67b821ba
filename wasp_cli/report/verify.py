"""Whether the files behind a report are those that were stored: tables trust sizes and the checksums of pages, this reads every byte."""

from __future__ import annotations

from collections.abc import Iterable

from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.store.artifact import corruption
from wasp_cli.store.layout import Layout


def altered(layout: Layout, artifacts: Iterable[tuple[str, str]]) -> tuple[int, list[str]]:
    """Compare the SHA-256 of every file of some artifacts with their manifests.

    Args:
        layout: the results folder.
        artifacts: kind and key of each; those that are not there are left out, as the report names them.

    Returns:
        How many were read, and what is wrong with each that differs.
    """
    read, wrong = 0, []
    for kind, key in dict.fromkeys(artifacts):
        try:
            if not layout.within(layout.manifest(kind, key)).is_file():
                continue
            found = corruption(layout, kind, key)
        except (ArtifactError, StoreError) as error:
            found = error.message
        except (OSError, AttributeError) as error:  # it changes now, or names no digests
            found = f"'{layout.artifact(kind, key)}': {error}"
        read += 1
        if found is not None:
            wrong.append(found)
    return read, wrong
