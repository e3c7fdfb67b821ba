"""The picture of docs/planner.md: an error that goes on is seen while one command does no harm."""

import futures
import numpy as np


def test_the_gate_fires_for_the_error_that_goes_on_and_for_no_single_command():
    found = futures.moment()
    assert found.fired
    assert found.costs["the command once, then the expert"] < 0.1
    assert found.costs["corrected now"] < 0.1
    assert found.costs["the error goes on"] > futures.TAU_C


def test_the_correction_comes_before_the_hazard():
    found = futures.moment()
    world = futures.Fork()
    centre = world.centre.numpy()
    place = found.way[-1]
    assert np.linalg.norm(place - centre) > world.radius + 0.3
    through = found.futures["the error goes on"]
    aside = found.futures["corrected now"]
    nearest = [np.linalg.norm(places - centre, axis=1).min() for places in (through, aside)]
    assert nearest[0] < nearest[1]


def test_the_picture_is_drawn(tmp_path):
    path = tmp_path / "futures.png"
    futures.draw(path)
    assert path.read_bytes().startswith(b"\x89PNG")
