"""The `wasp` program, also as `python -m wasp_cli`: what has to be so before anything else is
imported.
"""

import os
import sys

if (
    __name__ == "__main__"
    and not sys.flags.safe_path
    and sys.path[0] != os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
):
    # `python -m` searches the working directory, which may be somebody's results: a `numpy.py`
    # there would be imported. (A checkout that is not installed is found where it stands, or not at
    # all.)
    del sys.path[0]


def main() -> None:
    try:
        from wasp_cli.console import end_at_once

        end_at_once()
        from wasp_cli.cli import main as run

        try:
            run()
        finally:
            end_at_once()
    except KeyboardInterrupt:  # nobody has said better how it ends
        print("interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
