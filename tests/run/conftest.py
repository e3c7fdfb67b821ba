from tests.report.conftest import without_figures
from tests.run.harness import fakes, other_spec, small_spec
from tests.run.layered import computed, here, moved

__all__ = ["computed", "fakes", "here", "moved", "other_spec", "small_spec", "without_figures"]
