import pytest

from avp_habitat.collect import Collect, collect
from avp_habitat.rollout.format import read_rollout
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.budget import LEAST, MOST, budget_for


@pytest.mark.parametrize(("area_m2", "views"), [(25.0, 80), (15.0, 48), (1.0, LEAST), (1e4, MOST)])
def test_auto_gives_views_by_area_within_limits(area_m2, views):
    assert budget_for("auto", area_m2) == views
    assert budget_for(7, area_m2) == 7


def test_a_rollout_holds_the_number_that_auto_gave(tmp_path, capsys):
    collect(Collect("builtin:0", "random", tmp_path / "r", budget="auto", width=16, height=12), heldout=0)
    area_m2 = open_simulator(SimulatorChoice(), "builtin:0").area.area_m2
    found = read_rollout(tmp_path / "r")
    assert found.meta["budget"] == len(found.frames) == round(3.2 * area_m2)
    assert f"budget: {found.meta['budget']} views for {area_m2:.1f} m² of floor" in capsys.readouterr().out
