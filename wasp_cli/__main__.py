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
    # `python -m` searches the working directory first, which may be a folder of somebody's results:
    # a `numpy.py` there would be imported. It stays only if it is the checkout of this package.
    del sys.path[0]


def main() -> None:
    """Run the `wasp` program. Ctrl-C before and after a command ends the process with exit code
    130.
    """
    try:
        from wasp_cli.console import end_at_once

        end_at_once()
        from wasp_cli.cli import main as run

        try:
            run()
        finally:
            end_at_once()
    except KeyboardInterrupt:  # before the command could handle it
        print("interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
