"""What registry entries say of assistants, and what is no configuration."""

from typing import get_args

import pytest

from wasp_cli.errors import WaspError
from wasp_cli.methods.configs import WASPVariant
from wasp_cli.methods.registry import METHODS, MethodInfo
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
