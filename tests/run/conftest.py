from tests.report.conftest import without_figures
from tests.run.harness import fakes, other_spec, small_spec
from tests.run.layered import computed, fresh_console, here, moved

__all__ = [
    "computed",
    "fakes",
    "fresh_console",
    "here",
    "moved",
    "other_spec",
    "small_spec",
    "without_figures",
]
