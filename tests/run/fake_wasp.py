"""`wasp` with fake stages and no report, as a process that tests can kill: python
tests/run/fake_wasp.py run SPEC ...
"""

import json
import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

    import wasp_cli.cli
    import wasp_cli.cli.run
    from tests.run import fake_stages
    from tests.run.harness import LED_BY
    from wasp_cli.cells.asked import Asked
    from wasp_cli.console import out

    fake_stages.install()
    os.environ[LED_BY] = str(os.getpid())

    def show_cells(asked: Asked, *more: object, **options: object) -> SimpleNamespace:
        gate = json.loads(os.environ.get(fake_stages.OPTIONS, "{}")).get("report")
        while gate is not None and not Path(gate).exists():  # until someone lets it be written
            time.sleep(0.02)
        out().print(f"{len(asked.cells)} cells")
        return SimpleNamespace(missing=())

    wasp_cli.cli.run.show_report = show_cells
    wasp_cli.cli.main()
