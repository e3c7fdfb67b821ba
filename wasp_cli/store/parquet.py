"""How a table becomes a Parquet file and is read again: complete or not at all, with checksums
and a version in its metadata.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli.errors import StoreError

AGAIN = "run the spec again: what is damaged is computed again"


def write_table(
    table: pa.Table, path: Path, compression: str = "zstd", *, use_dictionary: bool = True
) -> None:
    """Write a table. The file appears complete or not at all; the same table gives the same
    bytes. Raises StoreError where the file cannot be written.
    """
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            level = 3 if compression == "zstd" else None
            pq.write_table(
                table,
                file,
                compression=compression,
                compression_level=level,
                use_dictionary=use_dictionary,
                write_page_checksum=True,
            )
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error


@contextmanager
def opened_table(
    path: Path, version_key: bytes, newest: int, what: str
) -> Iterator[pq.ParquetFile]:
    """Open a file that `write_table` wrote, for the block, after a check of its version.

    Args:
        path: of the file.
        version_key: where the version is in its metadata.
        newest: the newest version that can be read.
        what: what the file is, for messages.

    Raises:
        StoreError: there is no such file, it is another one, or of a newer version; or the block
            raised an error of pyarrow, a LookupError, TypeError or ValueError: it is damaged.
    """
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            marks = file.schema_arrow.metadata or {}
            if version_key not in marks:
                raise StoreError(f"{path} is a Parquet file, but not {what}")
            version = int(marks[version_key])
            if version > newest:
                raise StoreError(
                    f"{path} has table version {version}, this wasp reads up to {newest}",
                    "upgrade wasp, or use another results folder",
                )
            yield file
    except FileNotFoundError as error:
        raise StoreError(
            f"{path} does not exist", "run the spec again: what is finished is kept"
        ) from error
    except (LookupError, TypeError, ValueError, pa.ArrowException) as error:
        # some of pyarrow's errors are ValueErrors
        raise damaged(path, error) from error
    except OSError as error:
        if error.errno:
            raise StoreError(f"cannot read {path}: {error.strerror}") from error
        raise damaged(path, error) from error


def damaged(path: Path, error: Exception) -> StoreError:
    """Return the error of a file that cannot be what was written."""
    return StoreError(
        f"{path} is damaged or was cut off: {' '.join(str(error).split())[:200]}", AGAIN
    )
