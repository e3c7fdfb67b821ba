"""What registry entries say of assistants, and what readers are told where they say nothing."""

from typing import get_args

import pytest

from wasp_cli.errors import WaspError
from wasp_cli.methods.configs import WASPVariant
from wasp_cli.methods.registry import METHODS, MethodInfo
from wasp_cli.report.explain.episode import signal_of
from wasp_cli.report.explain.layout import decider
from wasp_cli.report.tables.table import variant_title, who_title
from wasp_cli.store.tables import Thresholds


@pytest.mark.parametrize("name", METHODS)
def test_an_entry_says_how_its_method_decides(name):
    info = METHODS[name]
    assert info.rule.endswith(".")
    config = info.config_model()

    limit = info.signal.limit
    assert not limit or limit in vars(Thresholds()) or limit in config.model_fields
    if len(info.variants) > 1:
        assert "variant" in config.model_fields


def test_the_variants_of_wasp_are_those_of_its_configuration():
    assert tuple(METHODS["printed"].variants) == tuple(METHODS["wasp"].variants) == get_args(WASPVariant)


def test_titles_of_variants():
    assert who_title("wasp", "full") == "WASP"
    assert who_title("wasp", "no-case2") == "WASP, no Case II recovery"
    assert variant_title("wasp", "of a later version") == "of a later version"


def test_a_method_that_no_registry_knows_keeps_its_name():
    assert who_title("gone", "fast") == "gone, fast"
    assert variant_title("gone", "fast") == "fast"
    assert signal_of("gone").name == "signal"
    assert decider("gone") == "gone"


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("wasp_cli.methods.human:HumanOnly", "is no configuration"),
        ("wasp_cli.methods.human:Nobody", "does not load"),
        ("wasp_cli.methods.nowhere:Config", "does not load"),
    ],
)
def test_what_is_no_configuration_is_said(config, message):
    with pytest.raises(WaspError, match=message):
        MethodInfo("mine", "Mine", "wasp_cli.methods.human:HumanOnly", config).config_model()
