from tests.run.harness import fakes, small_spec

__all__ = ["fakes", "small_spec"]
