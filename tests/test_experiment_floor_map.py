import csv
import json

import numpy as np
import pytest
from small_rollout import write_small_rollout

from avp_experiment.cells import floor_map
from avp_experiment.results import floor_of
from avp_habitat.rollout import images


def with_floor(folder, numbers):
    """A small rollout that has a floor."""
    write_small_rollout(folder)
    images.write_numbers(folder / "floor.png", numbers)
    meta = json.loads((folder / "rollout.json").read_text())
    meta["floor"] = {"file": "floor.png", "cell_m": 0.1, "origin_m": [1.0, -2.0], "shape": list(numbers.shape)}
    (folder / "rollout.json").write_text(json.dumps(meta))
    return folder


def test_a_map_of_a_rollout_holds_its_floor_and_its_path(tmp_path):
    numbers = np.array([[0, 1, 2], [3, 700, 0]], dtype=np.uint16)
    folder = with_floor(tmp_path / "r", numbers)
    add_yaw(folder / "steps.csv")
    found = json.loads(json.dumps(floor_map(folder)))
    np.testing.assert_array_equal(floor_of(found), numbers)
    assert (found["cell_m"], found["origin_m"], found["shape"]) == (0.1, [1.0, -2.0], [2, 3])
    rows = list(csv.DictReader((folder / "steps.csv").open()))
    assert found["path"] == [pytest.approx([float(r["x_m"]), float(r["z_m"]), 0.25], abs=1e-4) for r in rows]


def add_yaw(path):
    lines = path.read_text().splitlines()
    path.write_text("\n".join([f"{lines[0]},yaw_rad", *(f"{line},0.25" for line in lines[1:])]) + "\n")


def test_a_rollout_without_a_floor_has_no_map(tmp_path):
    assert floor_map(write_small_rollout(tmp_path / "r")) is None
