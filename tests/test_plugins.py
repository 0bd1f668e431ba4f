import sysconfig
import tomllib
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PLUGINS = tomllib.loads((ROOT / "plugins.toml").read_text(encoding="utf-8"))["plugin"]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def declared():
    return {
        (group, name, value) for group, entries in PROJECT["entry-points"].items() for name, value in entries.items()
    }


def test_the_manifest_and_the_entry_points_name_the_same_plugs():
    listed = {(p["group"], p["name"], p["object"]) for p in PLUGINS if p["group"] in PROJECT["entry-points"]}
    assert listed == declared()


def test_the_installed_entry_points_are_the_declared_ones():
    ours = {
        (point.group, point.name, point.value)
        for group in PROJECT["entry-points"]
        for point in entry_points(group=group)
        if point.dist is not None and point.dist.name == "avp-suite"
    }
    assert ours == declared()


def test_the_manifest_and_the_installed_programs_are_the_same():
    listed = {p["name"]: p["object"] for p in PLUGINS if p["group"] == "program on the path"}
    assert listed == PROJECT["scripts"]
    for name in listed:
        assert (Path(sysconfig.get_path("scripts")) / name).is_file()


@pytest.mark.parametrize("plugin", PLUGINS, ids=lambda plugin: plugin["name"])
def test_every_plug_of_the_manifest_can_be_loaded(plugin):
    module, name = plugin["object"].split(":")
    assert getattr(import_module(module), name) is not None
    assert plugin["shows"]


def test_the_zoo_finds_each_name_of_the_manifest_in_the_hyper_parameters():
    from avp_sb3.hyperparams import hyperparams

    named = {p["name"] for p in PLUGINS if p["group"] == "vec_env_wrapper"}
    assert {values["vec_env_wrapper"] for values in hyperparams.values()} == named
    assert set(hyperparams) == {p["name"] for p in PLUGINS if p["group"] == "registration on import"}
    callbacks = {p["object"].replace(":", ".") for p in PLUGINS if p["group"] == "callback"}
    assert {name for values in hyperparams.values() for name in values["callback"]} <= callbacks
