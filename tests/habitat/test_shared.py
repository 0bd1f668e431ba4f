"""Environments share one simulator of a scene, and a closed one is not handed out again."""

import gc

import numpy as np
import pytest

from avp_habitat.errors import SimulatorError
from avp_habitat.poses import Intrinsics
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.env import AVPEnv

pytestmark = pytest.mark.habitat


def test_environments_of_one_scene_share_a_simulator_and_the_next_scene_opens_when_they_are_gone():
    first, second = (AVPEnv("builtin:0", simulator="habitat", gpu=-1) for _ in range(2))
    assert first.simulator is second.simulator
    with pytest.raises(SimulatorError, match=r"one simulator, and this one has builtin:0 open already"):
        AVPEnv("builtin:1", simulator="habitat", gpu=-1)
    del first, second
    gc.collect()
    third = AVPEnv("builtin:1", simulator="habitat", gpu=-1)
    assert third.reset(seed=0)[0].shape == (12,)
    third.simulator.close()


def test_a_closed_simulator_says_so_and_is_opened_anew():
    closed = make_simulator("habitat", "builtin:0", gpu=-1)
    closed.close()
    closed.close()
    pose = np.eye(4)[None]
    with pytest.raises(SimulatorError, match=r"builtin:0 was closed; open the scene again"):
        closed.render(pose, Intrinsics.from_hfov(8, 8, hfov_deg=90.0), rgb=False)
    again = make_simulator("habitat", "builtin:0", gpu=-1)
    assert again is not closed
    assert again.render(pose, Intrinsics.from_hfov(8, 8, hfov_deg=90.0), rgb=False).depth.shape == (1, 8, 8)
    again.close()
