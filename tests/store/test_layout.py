from concurrent.futures import ThreadPoolExecutor

import pytest

from wasp_cli.errors import StoreError
from wasp_cli.store.layout import Layout


def test_runs_that_start_together_do_not_disturb_each_other(tmp_path):
    layout = Layout(tmp_path / "results")
    with ThreadPoolExecutor(8) as pool:
        for _ in pool.map(lambda _: layout.prepare(), range(400)):
            pass
    assert not list(layout.tmp.iterdir())


def test_a_name_that_no_file_can_have_is_refused(tmp_path):
    with pytest.raises(StoreError, match="file name too long"):
        Layout(tmp_path / ("x" * 300)).prepare()
