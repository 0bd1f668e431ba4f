import json
import shutil

import pytest
from experiment_results import SCENES, make_results, write_results

from avp_experiment.plots import style_of
from avp_experiment.report import main
from avp_experiment.results import read_results
from avp_habitat import command

TRAIN_ONLY = SCENES[:1]


@pytest.fixture(autouse=True)
def without_figures(monkeypatch):
    """Figures take most of a report's time."""
    monkeypatch.setattr("avp_experiment.report._figures", lambda shown: {})


def results_of(*methods, commit="0123456789abcdef", person="a", scenes=TRAIN_ONLY, **settings):
    results = make_results(methods, starts=1, seeds=2, prefixes=(), scenes=scenes)
    results["configuration"] |= settings
    results["origin"] |= {"command": f"compare by {person}", "commits": [commit]}
    for part in ("training", "rollouts", "reconstructions"):
        for one in results[part]:
            one["commit"] = commit
    return results


def measured_again(results, by=1.0):
    for one in results["reconstructions"]:
        one["scores"]["psnr"] += by
    return results


def started_later(results):
    """Other episodes."""
    for one in (*results["rollouts"], *results["reconstructions"]):
        one["start"] += 1
    results["configuration"]["starts"] = 2
    return results


@pytest.fixture
def merge(tmp_path, monkeypatch):
    """Writes results, by folder, and merges them into `m`; gives the exit code."""
    monkeypatch.chdir(tmp_path)

    def run(**by_folder):
        folders = [name.replace("__", "/") for name in by_folder]
        for folder, results in zip(folders, by_folder.values(), strict=True):
            if results is not None:
                write_results(tmp_path / folder, results)
        return command.run(main, [*folders, "--out", "m"])

    return run


def merged():
    with open("m/results.json", encoding="utf-8") as file:
        return json.load(file)


def origins_of_rows(folder="m"):
    """The lines of the page's table by method and label."""
    with open(f"{folder}/results.md", encoding="utf-8") as file:
        text = file.read().partition("## Where each row comes from\n")[2].partition("\n## ")[0]
    lines = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in text.strip().splitlines()]
    assert lines[0] == ["method", "results", "commits", "versions", "machine", "command"]
    return {(line[0], line[1]): line[2:] for line in lines[2:]}


def test_different_methods_become_rows_of_one_table_with_their_pictures(merge, tmp_path):
    b = results_of("greedy", commit="fedcba9876543210", person="b", scenes=SCENES)
    b["origin"]["versions"] = {"torch": "2.10", "numpy": "2.3"}
    assert merge(a=results_of("heuristic", "proposed"), b=b) == 0
    found = merged()
    assert found["methods"] == ["heuristic", "proposed", "greedy"]
    assert [scene["name"] for scene in found["configuration"]["scenes"]] == ["white.glb", "grey.glb"]
    assert found["sources"] == {"heuristic": ["a"], "proposed": ["a"], "greedy": ["b"]}
    assert len(read_results(tmp_path / "m").rollouts) == 2 + 2 + 4
    rows = origins_of_rows()
    assert rows["heuristic", "a"] == [
        "`0123456789ab`",
        "torch 2.9, numpy –",
        "Linux, a processor, 2 cores, no GPU",
        "`compare by a`",
    ]
    assert rows["greedy", "b"][:2] == ["`fedcba987654`", "torch 2.10, numpy 2.3"]
    pictures = {path.name: path.read_bytes() for path in (tmp_path / "m" / "pictures").iterdir()}
    assert pictures["grey-greedy-03.png"] == (tmp_path / "b/pictures/grey-greedy-03.png").read_bytes()
    assert {"white-truth-03.png", "white-proposed-05.png", "grey-truth-05.png"} <= set(pictures)


def test_a_method_that_two_people_measured_has_two_rows(merge, tmp_path):
    a, b = results_of("heuristic"), measured_again(results_of("heuristic", person="b"))
    assert merge(a=a, b=b) == 0
    assert merged()["methods"] == ["heuristic", "heuristic (b)"]
    assert set(origins_of_rows()) == {("heuristic", "a"), ("heuristic (b)", "b")}
    scores = {name: read_results(tmp_path / "m").values(name, "train", "psnr") for name in merged()["methods"]}
    assert all(scores["heuristic (b)"][key] == pytest.approx(psnr + 1) for key, psnr in scores["heuristic"].items())
    assert (tmp_path / "m/pictures/white-heuristic (b)-03.png").is_file()


def test_a_second_row_looks_like_the_first_but_dashed():
    assert style_of("proposed (b)") == (*style_of("proposed")[:2], "--")


def test_folders_of_the_same_last_name_give_distinct_rows(merge):
    several = [measured_again(results_of("heuristic"), by) for by in (0, 1, 2)]
    assert merge(a__e=several[0], b__e=several[1], c__e=several[2]) == 0
    assert merged()["methods"] == ["heuristic", "heuristic (e 2)", "heuristic (e 3)"]


def test_the_same_entries_are_kept_once(merge):
    assert merge(a=results_of("heuristic", "proposed"), b=results_of("heuristic", "proposed")) == 0
    assert merged()["methods"] == ["heuristic", "proposed"]
    assert {tuple(labels) for labels in merged()["sources"].values()} == {("a",)}


def test_other_episodes_by_the_same_commits_are_one_row_of_two_origins(merge):
    assert merge(a=results_of("heuristic"), b=started_later(results_of("heuristic", person="b"))) == 0
    assert merged()["methods"] == ["heuristic"]
    assert merged()["configuration"]["starts"] == 2
    assert len(merged()["rollouts"]) == 4
    assert set(origins_of_rows()) == {("heuristic", "a"), ("heuristic", "b")}


def trained_anew(results):
    for one in results["training"]:
        one["seconds"] += 1


@pytest.mark.parametrize("fault", ["other commits", "no commit known", "other policies"])
def test_other_episodes_of_something_else_are_a_row_of_their_own(merge, fault):
    commits = {"other commits": ("0", "1"), "no commit known": (None, None)}.get(fault, ("0", "0"))
    a, b = (results_of("proposed", commit=commit) for commit in commits)
    if fault == "other policies":
        trained_anew(b)
    assert merge(a=a, b=started_later(b)) == 0
    assert merged()["methods"] == ["proposed", "proposed (b)"]


def test_results_of_before_a_method_failed_less_are_completed(merge):
    before = results_of("heuristic", "proposed")
    before["rollouts"] = [one for one in before["rollouts"] if one["method"] != "proposed"]
    before["reconstructions"] = [one for one in before["reconstructions"] if one["method"] != "proposed"]
    before["failed"] = [{"cell": "collect/proposed", "reason": "no memory", "log": "log.txt"}]
    assert merge(a=before, b=results_of("heuristic", "proposed")) == 0
    assert merged()["methods"] == ["heuristic", "proposed"]
    with open("m/claims.md", encoding="utf-8") as file:
        assert "`collect/proposed` of a: no memory" in file.read()


def turned(digits):
    figures = {"turned": {"name": "turned", "title": "turned", "unit": "°", "digits": digits}}
    return results_of("heuristic", person=str(digits)) | {"figures": figures}


REFUSED = {
    "another version": (
        results_of("heuristic", preset="benchmark-v1"),
        results_of("greedy", preset="benchmark-v2"),
        ["benchmark-v1 in a, benchmark-v2 in b: results of different presets or versions of a benchmark cannot be"],
    ),
    "other settings": (
        results_of("heuristic"),
        results_of("greedy", steps=5, budget=40, starts=7),
        ["budget 80 in a, 40 in b; steps 700000 in a, 5 in b: results of different settings cannot be merged"],
    ),
    "another scene": (
        results_of("heuristic"),
        results_of("greedy", scenes=({**SCENES[0], "sha256": "f"},)),
        ["scene white.glb: sha256 a in a, f in b: expected one name, sha256 and role"],
    ),
    "another role": (
        results_of("heuristic"),
        results_of("greedy", scenes=({**SCENES[0], "role": "unseen"},)),
        ["role train in a, unseen in b"],
    ),
    "a name that pictures share": (
        results_of("heuristic"),
        results_of("greedy", scenes=({**SCENES[1], "name": "white.ply"},)),
        ["name white.glb in a, white.ply in b"],
    ),
    "another figure": (turned(0), turned(1), ["figure turned: digits 0 in a, 1 in b"]),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_results_that_do_not_belong_together_are_refused_before_anything_is_written(merge, tmp_path, capsys, fault):
    a, b, words = REFUSED[fault]
    assert merge(a=a, b=b) == 2
    error = capsys.readouterr().err
    assert all(one in error for one in words)
    assert not (tmp_path / "m").exists()


def test_a_damaged_second_file_is_named(merge, tmp_path, capsys):
    damaged = results_of("greedy")
    del damaged["rollouts"][0]["metrics"]
    assert merge(a=results_of("heuristic"), b=damaged) == 1
    assert "error: b/results.json: missing or damaged: KeyError('metrics')" in capsys.readouterr().err
    assert not (tmp_path / "m").exists()


def test_labels_without_an_origin_are_damage(merge, tmp_path, capsys):
    assert merge(a=results_of("heuristic")) == 0
    value = merged()
    value["sources"]["heuristic"] = ["b"]
    (tmp_path / "m/results.json").write_text(json.dumps(value))
    assert command.run(main, ["m"]) == 1
    assert "m/results.json: missing or damaged: ValueError(\"no origin of ['b']\")" in capsys.readouterr().err


def test_merging_again_gives_the_same_and_what_is_merged_merges(merge, tmp_path):
    several = {"a": results_of("heuristic", "proposed"), "b": measured_again(results_of("heuristic", person="b"))}
    assert merge(**several) == 0
    first, page = ((tmp_path / "m" / name).read_bytes() for name in ("results.json", "results.md"))
    (tmp_path / "m/pictures/white-greedy-03.png").touch()
    assert merge(**several) == 0
    assert (tmp_path / "m/results.json").read_bytes() == first
    assert not (tmp_path / "m/pictures/white-greedy-03.png").exists()
    assert command.run(main, ["m"]) == 0
    assert (tmp_path / "m/results.md").read_bytes() == page
    shutil.move("m", "before")
    assert merge(before=None) == 0
    assert (tmp_path / "m/results.json").read_bytes() == first
    # Its own parts are nothing new.
    assert merge(b=None, before=None) == 0
    assert merged()["methods"] == ["heuristic", "heuristic (a)", "proposed"]
    assert merged()["sources"]["heuristic (a)"] == ["a"]


def test_a_folder_of_something_else_is_not_written_into(merge, tmp_path, capsys):
    write_results(tmp_path / "m", results_of("greedy"), pictures=False)
    before = (tmp_path / "m/results.json").read_bytes()
    assert merge(a=results_of("heuristic")) == 2
    assert "--out m: holds the results of an experiment" in capsys.readouterr().err
    assert (tmp_path / "m/results.json").read_bytes() == before
    (tmp_path / "m/results.json").rename(tmp_path / "m/notes.json")
    assert merge(a=None) == 2
    assert "--out m: holds something else; expected a new or empty folder" in capsys.readouterr().err
    assert command.run(main, ["a", "--out", "./a"]) == 2
    assert "is one of the folders to merge" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a", "b"], "--out: 2 folders are merged into another: expected --out FOLDER"),
        ([], "expected the folder of an experiment"),
    ],
)
def test_folders_and_no_place_to_merge_them_into_are_refused(capsys, words, said):
    assert command.run(main, words) == 2
    assert said in capsys.readouterr().err


def test_an_unknown_method_of_the_maps_is_told_before_anything_is_written(merge, tmp_path, capsys):
    assert merge(a=results_of("heuristic")) == 0
    assert command.run(main, ["a", "--out", "n", "--maps", "heuristik"]) == 2
    assert "did you mean 'heuristic'?" in capsys.readouterr().err
    assert not (tmp_path / "n").exists()


def both_starts(commit="0123456789abcdef"):
    """An experiment that was gone on with: the episodes of `results_of` and those of `started_later`."""
    first, later = results_of("heuristic"), started_later(results_of("heuristic", commit=commit))
    for part in ("rollouts", "reconstructions"):
        first[part] += later[part]
    first["configuration"]["starts"] = 2
    return first


@pytest.mark.parametrize("order", ["early later both", "both early later", "later both early"])
def test_what_one_result_holds_of_another_is_kept_once_in_any_order(merge, order):
    known = {
        "early": results_of("heuristic"),
        "later": started_later(results_of("heuristic", commit="fedcba9876543210")),
        "both": both_starts(commit="fedcba9876543210"),
    }
    assert merge(**{name: known[name] for name in order.split()}) == 0
    assert merged()["methods"] == ["heuristic"]
    assert len(merged()["rollouts"]) == 4


def test_weights_of_two_people_in_folders_of_one_name_are_two_rows(merge):
    a, b = results_of("heuristic"), started_later(results_of("heuristic", person="b"))
    for results in (a, b):
        results["methods"] = ["runs.weights"]
        for part in ("rollouts", "reconstructions"):
            for one in results[part]:
                one["method"] = "runs.weights"
    assert merge(a=a, b=b) == 0
    assert merged()["methods"] == ["runs.weights", "runs.weights (b)"]
