"""Everything that README.md tells its reader to type, taken from the page and run, shortened where it takes long.

`FORMS` has an entry for each command and each block of Python. One that is added or changed there without an entry here
fails, and so does a text to be shortened that the command has no more.
"""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
import urllib.request
from contextlib import ExitStack, chdir, suppress
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from nerfstudio_shell import Shell
from rrd import verify
from tracking_server import free_port

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
CPU = (
    "--max-num-iterations 3 --timestamp t --vis tensorboard --machine.device-type cpu "
    "--pipeline.model.implementation torch --pipeline.model.log2-hashmap-size 10 "
    "--pipeline.datamanager.train-num-rays-per-batch 128"
)
SMALL = "--width 16 --height 12 --budget 8"
PICTURES = "--budget 8 --width 64 --height 48"
COLLECT = "python -m avp_habitat.collect --scene builtin:0 --policy heuristic"
CONFIG = "outputs/r0/avp-nerfacto/t/config.yml"


@dataclass(frozen=True)
class Form:
    """How a command of the page, or a block of Python, is run here."""

    prints: str
    """What is found in its output."""
    changes: dict[str, str] = field(default_factory=dict)
    """Texts of the command, each of which must occur, and what stands there instead."""
    needs: tuple[str, ...] = ()
    """Beginnings of the commands (and headings of the blocks) that must have been run before."""
    codes: tuple[int, ...] = (0,)
    """The exit codes that it may have."""
    slow: bool = False
    serves: bool = False
    """A server: started on a free port, asked whether it is well, and stopped."""
    saves: str = ""
    """A recording that Rerun saves instead of opening its window."""
    weights: bool = False
    """Needs LPIPS's weights, which nerfstudio would download."""


# A dry run says what `make` would do; what it runs is tested by itself: examples/demo.py, setup.sh, and these tests.
FORMS = {
    "python -m avp_habitat.collect --scene white_room.glb --policy pretrained --out runs/mine": Form(
        r"opening builtin:0 for pretrained \(multiview, version \d+\)(?s:.*)runs/mine: 8 views, coverage [\d.]+ %",
        {"white_room.glb": f"builtin:0 {PICTURES}"},
    ),
    "make demo": Form(r"examples/demo\.py", {"make": f"make --dry-run --directory {ROOT}"}),
    "make test": Form(r'-m pytest .* -m "not slow"', {"make": f"make --dry-run --directory {ROOT}"}),
    # tests/test_experiment_compare.py runs it whole, in minutes; here it gets as far as its parameters.
    "mlflow run . -e compare --env-manager local -P scene=white_room.glb -P unseen=grey_white_room.glb -P starts=3"
    " -P preset=cpu": Form(
        r"^error: unknown preset 'nosuch': expected one of .*cpu",
        {
            "run .": f"run {ROOT}",
            "=white_room.glb": "=builtin:0",
            "=grey_white_room.glb": "=builtin:1",
            "=cpu": "=nosuch",
        },
        codes=(1,),
    ),
    "python -m avp_habitat.scenes.export builtin:3 room.glb": Form(r"wrote room\.glb"),
    f"{COLLECT} --seed 0 --out runs/r0": Form(
        r"runs/r0: 8 views, coverage [\d.]+ %(?s:.*)coverage(?s:.*)look: +runs/r0/trajectory.png",
        {"--seed 0": f"--seed 0 {PICTURES}"},
    ),
    "python -m avp_habitat.seen runs/r0": Form(
        r"rollout +scene +policy +views +coverage +visibility.*\nruns/r0 +builtin:0 +heuristic +8 ",
        needs=(COLLECT,),
    ),
    "python -m avp_habitat.geometry runs/r0 --scene builtin:0": Form(
        r"shape +scene +policy +views +completion ratio \[%\](?s:.*)\nruns/r0 +builtin:0 +heuristic +8 ",
        needs=(COLLECT,),
    ),
    "Gymnasium": Form(r"^0\.159\d+$"),
    "Stable-Baselines3": Form(
        r"",
        {
            "lookup=True": "lookup=True, width=16, height=12, budget=8",
            'EvaluationCallback("builtin:7")': 'EvaluationCallback("builtin:0", episodes=2)',
            "300_000": "2_048",
        },
    ),
    "rl_zoo3 train --algo ppo --env AVP-v0 --gym-packages avp_habitat --conf-file avp_sb3.hyperparams"
    " --env-kwargs scene:\"'builtin:0'\" reward:\"'proposed'\" --device cpu --num-threads 1": Form(
        r"Saving to logs/ppo/AVP-v0_1",
        {
            "reward:\"'proposed'\"": "reward:\"'proposed'\" width:16 height:12 budget:8",
            "--algo ppo": "--algo ppo -n 2048 --eval-freq -1",
        },
        slow=True,
    ),
    "python -m avp_habitat.collect --scene builtin:0 --policy logs/ppo/AVP-v0_1/AVP-v0.zip --out runs/learned": Form(
        r"runs/learned: \d+ views", {"--out": f"{PICTURES} --out"}, needs=("rl_zoo3 train",), slow=True
    ),
    "python -m avp_sb3.evaluate --scene builtin:0 --policy heuristic --policy greedy --policy ppo.zip"
    " --stochastic": Form(
        r"\| figure +\| heuristic +\| greedy +\| ppo\.zip +\|(?s:.*)\| coverage \[%\](?s:.*)MLflow: +run \w+ in exp",
        {"--stochastic": f"--stochastic --episodes 2 {SMALL}"},
        needs=("Stable-Baselines3",),
    ),
    "mlflow ui --backend-store-uri sqlite:///mlflow.db": Form(
        r"", needs=("python -m avp_sb3.evaluate",), serves=True, slow=True
    ),
    "python -m avp_habitat.tracking.compare": Form(
        r"\| policy +\| scene(?s:.*)\| greedy +\| builtin:0 +\| evaluation", needs=("python -m avp_sb3.evaluate",)
    ),
    "rerun training.rrd": Form(r"", needs=("Stable-Baselines3",), saves="again.rrd"),
    "rerun runs/r0/rollout.json": Form(r"", needs=(COLLECT,), saves="rollout.rrd"),
    "ns-train avp-nerfacto --data runs/r0": Form(
        r"avp-nerfacto",
        {"--data runs/r0": f"--data runs/r0 {CPU}"},
        needs=(COLLECT,),
    ),
    # Where there is no GPU it says at once what to type instead: the line after it on the page.
    "ns-train nerfacto avp-data --data runs/r0": Form(
        r"none was found here.*--machine.device-type cpu|Trainer.*finished|Training Finished",
        {"avp-data": "--max-num-iterations 3 --vis tensorboard avp-data"},
        codes=(0, 1),
        needs=(COLLECT,),
        weights=True,
    ),
    "ns-train nerfacto --machine.device-type cpu --pipeline.model.implementation torch --mixed-precision False"
    " avp-data --data runs/r0": Form(
        r"nerfacto",
        {
            "--mixed-precision False": "--mixed-precision False --max-num-iterations 3 --timestamp t --vis tensorboard "
            "--pipeline.model.log2-hashmap-size 10 --pipeline.datamanager.train-num-rays-per-batch 128"
        },
        needs=(COLLECT,),
        slow=True,
        weights=True,
    ),
    "ns-eval --load-config outputs/…/config.yml --output-path scores.json": Form(
        r"Saved results to: scores\.json", {"outputs/…/config.yml": CONFIG}, needs=("ns-train avp-nerfacto",)
    ),
    "python -m avp_nerfstudio.log outputs/…/config.yml": Form(
        r"psnr", {"outputs/…/config.yml": CONFIG}, needs=("ns-train avp-nerfacto",), slow=True
    ),
    "python -m avp_nerfstudio.check runs/r0 --mesh builtin:0": Form(
        r"PASS  depth agreement: [\d.]+ % of \d+ points seen twice agree within 2 cm(?s:.*)PASS  mesh distance: ",
        {"runs/r0": "runs/r0 --no-pictures"},
        needs=(COLLECT,),
    ),
    "python -m avp_habitat.doctor": Form(r"ok  simulator raycast(?s:.*)ok  plug AVP-v0", slow=True),
    "python -m avp_habitat.collect --simulator habitat --scene room.glb --policy frontier --out runs/h0": Form(
        r"^runs/h0: 8 views|^error: .*habitat-sim is not installed.*build version 0.3.4 from its sources",
        {"--policy frontier": f"--policy frontier {PICTURES}"},
        codes=(0, 1),
        needs=("python -m avp_habitat.scenes.export",),
    ),
}
"""By the command in one line without its comment, or by the heading above a block of Python."""


def blocks_of(page):
    """`(heading, text)` of every indented block."""
    found, heading = [], ""
    for part in re.split(r"^(## .*)$", page, flags=re.MULTILINE):
        heading = part.removeprefix("## ") if part.startswith("## ") else heading
        found += [
            (heading, re.sub(r"^ {4}", "", text, flags=re.MULTILINE))
            for text in re.findall(r"(?<=\n\n)(?: {4}.*\n(?:\n(?= {4}))*)+", part)
        ]
    return found


def commands_of(block):
    """The commands of a block, each in one line and without its comment; none of a block of Python."""
    lines = re.sub(r"\\\n\s*", "", block).splitlines()
    typed = [re.sub(r"^\$ ", "", line) for line in lines if re.match(r"\$ |make ", line)]
    return [re.sub(r"\s+#\s.*$", "", line) for line in typed]


def typed_in(page):
    """What the page tells to run, by the key that it has in `FORMS`."""
    found = {}
    for heading, block in blocks_of(page):
        commands = commands_of(block)
        new = {command: command for command in commands} if commands else {heading: block}
        assert not new.keys() & found.keys(), f"README.md says twice: {new.keys() & found.keys()}"
        found |= new
    return found


def faults(page):
    """What the page tells to run that has no form here, and the other way round."""
    typed = typed_in(page)
    return [f"not run by any test: {text}" for text in typed if text not in FORMS] + [
        f"not in README.md any more: {text}" for text in FORMS if text not in typed
    ]


def shortened(text, form):
    for old, new in form.changes.items():
        assert old in text, f"README.md has no {old!r} any more in: {text}"
        text = text.replace(old, new)
    return text


def key_of(beginning):
    (key,) = [key for key in FORMS if key.startswith(beginning)]
    return key


class Reader:
    """Somebody who types what the page says, each thing once, in one folder, after what it needs."""

    def __init__(self, folder, stack, weights):
        self.folder, self.done = folder, {}
        self._stack, self._shell = stack, None
        self._environment = {
            **{
                name: text
                for name, text in os.environ.items()
                if name not in ("MLFLOW_TRACKING_URI", "AVP_MLFLOW_SPOOL")
            },
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "TORCH_HOME": str(weights if weights.is_dir() else folder / "no-weights"),
            "https_proxy": "http://127.0.0.1:9",
            "PYTHONWARNINGS": "ignore",
            "MLFLOW_DISABLE_TELEMETRY": "true",
        }

    def run(self, key):
        """What it printed."""
        if key not in self.done:
            form = FORMS[key]
            for needed in form.needs:
                self.run(key_of(needed))
            self.done[key] = self._served(key) if form.serves else self._finished(key, form)
        return self.done[key]

    def _finished(self, key, form):
        code, output = self._typed(shortened(typed_in(README)[key], form), form)
        assert code in form.codes, output[-5000:]
        assert re.search(form.prints, output, re.MULTILINE), output[-5000:]
        assert "Traceback" not in output, output[-5000:]
        return output

    def _typed(self, text, form):
        if "\n" in text:
            return self._started([sys.executable, "-c", text])
        if text.startswith("ns-"):
            return self._forked(text)
        if form.saves:
            text += f" --save {form.saves} --port auto --bind 127.0.0.1"
        return self._started(["bash", "-c", text])

    def _started(self, line):
        done = subprocess.run(
            line, cwd=self.folder, env=self._environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, timeout=500, check=False,
        )  # fmt: skip
        return done.returncode, done.stdout

    def _forked(self, text):
        if self._shell is None:
            with chdir(self.folder):
                self._shell = self._stack.enter_context(Shell())
        done = self._shell.run(*shlex.split(text), environment=self._environment, cwd=self.folder)
        return done.returncode, done.stdout + done.stderr

    def _served(self, key):
        """What the server said while it was up and answered."""
        port = free_port()
        with (self.folder / "served").open("w+") as output:
            server = subprocess.Popen(
                [*shlex.split(key), "--port", str(port), "--workers", "1"], cwd=self.folder, env=self._environment,
                stdout=output, stderr=output, start_new_session=True,
            )  # fmt: skip
            try:
                assert answers(server, f"http://127.0.0.1:{port}/health"), (self.folder / "served").read_text()
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20) as page:
                    assert "MLflow" in page.read().decode()
            finally:
                os.killpg(server.pid, signal.SIGKILL)
                server.wait()
        return (self.folder / "served").read_text()


def answers(server, address, seconds=120):
    until = time.monotonic() + seconds
    while time.monotonic() < until and server.poll() is None:
        with suppress(OSError), urllib.request.urlopen(address, timeout=2) as answer:
            return answer.status == 200
        time.sleep(0.2)
    return False


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    with ExitStack() as stack:
        yield Reader(tmp_path_factory.mktemp("readme"), stack, ROOT.parent / "shared" / "torch_home")


def parameters():
    return [
        pytest.param(key, id=" ".join(key.split()[:6]), marks=[pytest.mark.slow] if form.slow else [])
        for key, form in FORMS.items()
    ]


def test_everything_that_the_page_tells_to_run_is_run_here():
    assert "```" not in README, "blocks of the README are indented"
    assert faults(README) == []


def test_a_command_that_is_new_or_changed_would_be_found():
    new = README + "\n## New\n\n    $ python -m avp_habitat.new \\\n        --option 1     # why\n    out\n"
    assert faults(new) == ["not run by any test: python -m avp_habitat.new --option 1"]
    assert faults(README + "\n## More\n\n    import this\n\n    print(1)\n") == ["not run by any test: More"]
    changed = README.replace("--policy heuristic --seed 0", "--policy spin --seed 0")
    assert [fault.partition(":")[0] for fault in faults(changed)] == [
        "not run by any test",
        "not in README.md any more",
    ]
    with pytest.raises(AssertionError, match="has no '--seed 0' any more"):
        shortened("python -m avp_habitat.collect --seed 1", FORMS[key_of(COLLECT)])


def test_what_is_quick_needs_nothing_slow():
    quick = {key: form for key, form in FORMS.items() if not form.slow}
    assert [key for key, form in quick.items() for needed in form.needs if FORMS[key_of(needed)].slow] == []


def test_the_targets_and_files_that_the_text_names_are_there():
    targets = set(re.findall(r"`(make [a-z-]+)`", README))
    assert {"make demo", "make docs", "make check", "make test-all"} <= targets
    for target in targets:
        line = ["make", "--dry-run", "--directory", str(ROOT), target.removeprefix("make ")]
        assert subprocess.run(line, capture_output=True, check=False).returncode == 0, target
    for name in re.findall(r"\]\(([^)#]+)", README):
        assert name.startswith("http") or (ROOT / name).exists(), name


@pytest.mark.parametrize("key", parameters())
def test_the_page_can_be_typed(reader, request, key):
    form = FORMS[key]
    if form.weights:
        request.getfixturevalue("shared")
    reader.run(key)
    if form.saves:
        verify(reader.folder / form.saves)
