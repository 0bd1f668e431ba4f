import json
from collections import Counter
from dataclasses import replace
from itertools import groupby

import pytest

from avp_experiment import compare
from avp_experiment.cells import COLLECT, RECONSTRUCT, TRAIN, plan
from avp_experiment.configuration import DEFAULT, PRESETS, Configuration, ExperimentScene, chosen_methods, known_methods
from avp_experiment.folder import Folder, open_folder
from avp_experiment.plots import style_of
from avp_habitat import command

SCENES = (ExperimentScene("a.glb", "a.glb", "11", "train"), ExperimentScene("dir/b.glb", "b.glb", "22", "unseen"))


def configuration(methods=("heuristic", "coverage", "proposed_rooms"), seeds=2, **changes):
    preset = replace(PRESETS["cpu"], **{"seeds": seeds, "starts": 2, "prefixes": (20, 40), "rooms": 3} | changes)
    return Configuration("cpu", preset, SCENES, chosen_methods(methods))


def option(cell, name):
    return cell.words[cell.words.index(name) + 1]


def test_the_matrix_holds_every_training_rollout_and_reconstruction(tmp_path):
    cells = plan(configuration(), tmp_path, tracking="avp")
    rollouts = 3 * 2 * 2 * 2  # methods, scenes, seeds, starts
    assert Counter(cell.kind for cell in cells) == {
        TRAIN: 2 * 2,
        COLLECT: rollouts,
        RECONSTRUCT: rollouts * (1 + 2),  # all frames, and two prefixes
    }
    assert len({cell.key for cell in cells}) == len(cells)


def test_each_cell_stands_after_the_one_that_it_needs(tmp_path):
    cells = plan(configuration(DEFAULT), tmp_path, tracking="avp")
    place = {cell.key: i for i, cell in enumerate(cells)}
    assert all(place[cell.needs.key] < place[cell.key] for cell in cells if cell.needs is not None)


def test_all_methods_start_at_the_same_places_and_no_place_comes_twice(tmp_path):
    rollouts = [cell for cell in plan(configuration(), tmp_path, tracking="avp") if cell.kind == COLLECT]
    where = lambda cell: (cell.scene.name, cell.seed, cell.start)  # noqa: E731
    starts = {}
    for key, group in groupby(sorted(rollouts, key=where), where):
        found = {option(cell, "--seed") for cell in group}
        assert len(found) == 1
        starts.setdefault(key[0], []).extend(found)
    assert all(len(set(seeds)) == 4 for seeds in starts.values())


def test_the_users_number_of_starts_replaces_the_presets():
    found = compare.Compare(preset="smoke", starts="4", unseen="none").configuration()
    assert found.preset == replace(PRESETS["smoke"], starts=4)


def test_what_others_bring_is_a_method_and_a_figure_by_its_place(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "brought.py").write_text(
        "from avp_habitat import Figure, metric, reward\n"
        "class Still:\n"
        "    def __init__(self, env, seed=None): ...\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=False): ...\n"
        "@reward(needs_surface=True)\n"
        "def thrifty(facts, constants): ...\n"
        "@metric(Figure('turned', 'turned'))\n"
        "def turned(trajectory): ...\n"
    )
    words = {"methods": "brought:thrifty_rooms,brought:Still,random", "metrics": "brought:turned", "unseen": "none"}
    found = compare.Compare(preset="smoke", **words).configuration()
    cells = plan(found, tmp_path, tracking="avp")
    training, *rollouts = [cell for cell in cells if cell.kind != RECONSTRUCT]
    assert training.name == "brought.thrifty_rooms-0"
    assert [option(training, name) for name in ("--reward", "--observation", "--scene")] == [
        "brought:thrifty",
        "surface_map",
        "builtin:100",
    ]
    assert [option(cell, "--policy") for cell in rollouts] == [
        "random",
        str(training.output(tmp_path)),
        "brought:Still",
    ]
    assert {option(cell, "--metrics") for cell in rollouts} == {"brought:turned"}


def test_more_starts_leave_what_is_there(tmp_path):
    few, more = (plan(configuration(starts=starts), tmp_path, tracking="avp") for starts in (1, 3))
    words = {cell.key: cell.words for cell in more}
    assert all(words[cell.key] == cell.words for cell in few)
    open_folder(configuration(starts=1), tmp_path)
    open_folder(configuration(starts=3), tmp_path)
    open_folder(configuration(starts=2), tmp_path)


def test_a_policy_is_trained_in_the_scenes_of_training_or_in_rooms_and_never_in_unseen_ones(tmp_path):
    trainings = [cell for cell in plan(configuration(), tmp_path, tracking="avp") if cell.kind == TRAIN]
    words = {cell.method.name: cell.words for cell in trainings}
    scenes = {name: line[line.index("--scene") + 1 : line.index("--reward")] for name, line in words.items()}
    assert scenes["coverage"] == ("a.glb",)
    assert len(scenes["proposed_rooms"]) == 3
    assert all(room.startswith("builtin:") for room in scenes["proposed_rooms"])


def test_a_scene_of_the_experiment_is_no_room_of_training():
    taken = configuration().rooms[1]
    scenes = (ExperimentScene(taken, taken, "33", "unseen"), *SCENES)
    rooms = replace(configuration(), scenes=scenes).rooms
    assert taken not in rooms
    assert len(rooms) == 3


def test_only_whole_rollouts_of_the_first_seed_and_start_keep_pictures(tmp_path):
    cells = [cell for cell in plan(configuration(), tmp_path, tracking="avp") if "--pictures" in cell.words]
    assert {(cell.seed, cell.start, cell.frames) for cell in cells} == {(0, 0, None)}
    assert len(cells) == 3 * 2


def test_what_a_finished_training_left_is_not_begun_again_and_an_interrupted_one_goes_on(tmp_path):
    folder = Folder(tmp_path)
    training = plan(configuration(), tmp_path, tracking="avp")[0]
    assert folder.prepare(training) == training.words
    training.output(tmp_path).write_bytes(b"a model")
    assert folder.prepare(training)[-2:] == ("--resume", str(training.output(tmp_path)))
    folder.fail(training, "of its model")
    assert folder.prepare(training) == training.words
    assert not training.output(tmp_path).exists()
    folder.finish(training, {"seconds": 1.0})
    assert folder.is_done(training)


def test_what_an_interrupted_rollout_left_is_cleared(tmp_path):
    folder = Folder(tmp_path)
    rollout = next(cell for cell in plan(configuration(), tmp_path, tracking="avp") if cell.kind == COLLECT)
    rollout.output(tmp_path).mkdir(parents=True)
    assert folder.prepare(rollout) == rollout.words
    assert not rollout.output(tmp_path).exists()


def test_first_frames_that_are_all_of_a_short_rollout_are_not_reconstructed_twice(tmp_path):
    folder = Folder(tmp_path)
    cells = plan(configuration(), tmp_path, tracking="avp")
    prefixes = [cell for cell in cells if cell.frames is not None][:2]
    assert {cell.frames for cell in prefixes} == {20, 40}
    folder.prepare(prefixes[0].needs)
    folder.finish(prefixes[0].needs, {"facts": {"metrics": {"views": 30.0}}})
    assert {cell.frames: folder.is_done(cell) for cell in prefixes} == {20: False, 40: True}


def test_a_folder_keeps_one_configuration_and_takes_more_methods(tmp_path):
    open_folder(configuration(), tmp_path / "e")
    open_folder(configuration(("greedy", "surface")), tmp_path / "e")
    with pytest.raises(Exception, match=r"another configuration: seeds 2 there, 5 asked for"):
        open_folder(configuration(seeds=5), tmp_path / "e")


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("three years of work")
    with pytest.raises(Exception, match=r"is no experiment's folder"):
        open_folder(configuration(), tmp_path)
    (tmp_path / "experiment.json").write_text("{")
    with pytest.raises(Exception, match=r"experiment\.json: expected an experiment's configuration"):
        open_folder(configuration(), tmp_path)


def refused(capsys, *words):
    """Exit code and the one line that a command line earns."""
    code = command.run(compare.main, words)
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return code, lines[0]


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (
            ("--preset", "cpuu"),
            2,
            "expected one of benchmark-v1, benchmark-v1-full, cpu, demo, gpu, paper, smoke; did you mean 'cpu'?",
        ),
        (("--methods", "heuristic,propposed"), 2, "did you mean 'proposed'?"),
        (("--methods", ","), 2, "methods: expected at least one"),
        (("--seeds", "0"), 2, "seeds: expected a whole number from 1, or auto, got '0'"),
        (("--starts", "0"), 2, "starts: expected a whole number from 1, or auto, got '0'"),
        (("--seeds", "2.5"), 2, "seeds: expected a whole number"),
        (("--jobs", "-1"), 2, "jobs: expected a whole number"),
        (("--simulator", "raycats"), 2, "did you mean 'raycast'?"),
        (("--scene", ","), 2, "scene: expected at least one"),
        (("--scene", "builtin:0,gone.glb"), 1, "gone.glb"),
        (("--unseen", "builtin:0"), 2, "builtin:0: the same scene as builtin:0, given as train"),
    ],
)
def test_what_cannot_be_right_is_refused_before_anything_is_written(tmp_path, monkeypatch, capsys, words, code, text):
    monkeypatch.chdir(tmp_path)
    found, line = refused(capsys, "--preset", "smoke", *words)
    assert (found, text in line) == (code, True), line
    assert list(tmp_path.iterdir()) == []


def test_an_unreadable_scene_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.glb").write_bytes(b"glTF is not this")
    code, line = refused(capsys, "--preset", "smoke", "--scene", "builtin:0,broken.glb")
    assert code == 1
    assert "broken.glb" in line


def test_a_second_program_in_the_same_folder_is_refused(tmp_path):
    with (
        Folder(tmp_path).alone(),
        pytest.raises(Exception, match="another program is working"),
        Folder(tmp_path).alone(),
    ):
        pass
    with Folder(tmp_path).alone():
        pass


def test_the_configuration_that_is_kept_is_readable(tmp_path):
    open_folder(configuration(), tmp_path / "e")
    found = json.loads((tmp_path / "e" / "experiment.json").read_text())
    assert found["seeds"] == 2
    assert [scene["role"] for scene in found["scenes"]] == ["train", "unseen"]


def test_weights_are_methods_as_they_are_and_tuned_and_folders_called_like_rewards_are_none(tmp_path, monkeypatch):
    (tmp_path / "surface").mkdir()
    monkeypatch.chdir(tmp_path)
    methods = chosen_methods(("pretrained_tuned", "surface", "pretrained"))
    assert [(method.name, method.learned, method.reward) for method in methods] == [
        ("pretrained", False, "multiview"),
        ("surface", True, "surface"),
        ("pretrained_tuned", True, "multiview"),
    ]
    cell = next(each for each in plan(configuration(("pretrained_tuned",)), tmp_path, tracking="avp"))
    assert "--start pretrained" in cell.command


def test_every_method_has_a_style_of_its_own():
    styles = [style_of(method) for method in known_methods()]
    assert len(set(styles)) == len(styles)
