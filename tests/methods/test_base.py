"""What the closed loop asks of every decision."""

import pytest
import torch

from wasp_cli.errors import WaspError
from wasp_cli.methods.base import Decision, checked
from wasp_cli.methods.record import blank_record

COMMANDS = torch.tensor([[0.5, -0.5], [0.0, 1.0]])
CHANGED = torch.tensor([[0.5, -0.5], [0.0, 0.9]])


class Mine:
    """The assistant that is named in messages."""


def test_a_command_may_change_where_a_gate_fired():
    record = blank_record(2)
    record.gate[1] = 3
    decision = Decision(CHANGED, record)
    assert checked(decision, Mine(), COMMANDS, COMMANDS.clone()) is decision


@pytest.mark.parametrize(
    ("decision", "message"),
    [
        (CHANGED, "'Mine' returned a Tensor, not a Decision"),
        (None, "'Mine' returned a NoneType, not a Decision"),
        (Decision(CHANGED), "'Mine' changed a command without a record"),
        (Decision(CHANGED, blank_record(2)), "although its record says that no gate fired"),
        (Decision(CHANGED[0]), r"shape \[2\] for commands of shape \[2, 2\]"),
    ],
)
def test_what_breaks_the_contract_is_said(decision, message):
    with pytest.raises(WaspError, match=message):
        checked(decision, Mine(), COMMANDS, COMMANDS.clone())


@pytest.mark.parametrize("to", [0.0, torch.nan])
def test_a_command_that_was_changed_in_place_is_refused(to):
    """What is recorded as the command would be what the assistant made of it, without any intervention."""
    commands = COMMANDS.clone()
    given = commands.clone()
    commands[1] = to
    with pytest.raises(WaspError, match="'Mine' changed the operator's command in place"):
        checked(Decision(commands), Mine(), commands, given)
