"""A policy that Stable-Baselines3 saved: what its file would run, and the statistics of `VecNormalize` beside it."""

import base64
import importlib
import io
import json
import pickle
import re
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import PolicyError

_KNOWN = {
    "collections": "deque OrderedDict",
    "gymnasium.spaces.box": "Box",
    "gymnasium.spaces.dict": "Dict",
    "gymnasium.spaces.discrete": "Discrete",
    "gymnasium.spaces.multi_binary": "MultiBinary",
    "gymnasium.spaces.multi_discrete": "MultiDiscrete",
    "numpy": "dtype ndarray bool_ float32 float64 int8 int32 int64 uint8",
    **{
        f"numpy.{core}.{module}": "_reconstruct scalar _frombuffer"
        for core in ("core", "_core")
        for module in ("multiarray", "numeric")
    },
    "numpy.random._pcg64": "PCG64",
    "numpy.random._pickle": "__bit_generator_ctor __generator_ctor",
    "numpy.random.bit_generator": "SeedSequence __pyx_unpickle_SeedSequence",
    "pathlib": "Path PosixPath PurePosixPath WindowsPath",
    "pathlib._local": "Path PosixPath PurePosixPath WindowsPath",
    "rl_zoo3.utils": "SimpleLinearSchedule",
    "sb3_contrib.ars.policies": "ARSLinearPolicy ARSPolicy",
    "sb3_contrib.common.maskable.buffers": "MaskableDictRolloutBuffer MaskableRolloutBuffer",
    "sb3_contrib.common.maskable.policies": "MaskableActorCriticCnnPolicy MaskableActorCriticPolicy "
    "MaskableMultiInputActorCriticPolicy",
    "sb3_contrib.common.recurrent.buffers": "RecurrentDictRolloutBuffer RecurrentRolloutBuffer",
    "sb3_contrib.common.recurrent.policies": "RecurrentActorCriticCnnPolicy RecurrentActorCriticPolicy "
    "RecurrentMultiInputActorCriticPolicy",
    "sb3_contrib.qrdqn.policies": "CnnPolicy MultiInputPolicy QRDQNPolicy",
    "stable_baselines3.common.buffers": "DictReplayBuffer DictRolloutBuffer ReplayBuffer RolloutBuffer",
    "stable_baselines3.common.policies": "ActorCriticPolicy ActorCriticCnnPolicy MultiInputActorCriticPolicy",
    "stable_baselines3.common.running_mean_std": "RunningMeanStd",
    "stable_baselines3.common.torch_layers": "CombinedExtractor FlattenExtractor NatureCNN",
    "stable_baselines3.common.sb2_compat.rmsprop_tf_like": "RMSpropTFLike",
    "stable_baselines3.common.type_aliases": "TrainFreq TrainFrequencyUnit",
    "stable_baselines3.common.utils": "ConstantSchedule FloatSchedule LinearSchedule",
    "stable_baselines3.common.vec_env.vec_normalize": "VecNormalize",
    "stable_baselines3.dqn.policies": "CnnPolicy DQNPolicy MultiInputPolicy",
    "torch.nn.modules.activation": "CELU ELU GELU Hardsigmoid Hardswish Hardtanh LeakyReLU LogSigmoid Mish PReLU RReLU "
    "ReLU ReLU6 SELU Sigmoid SiLU Softplus Softsign Tanh Tanhshrink",
    "torch.nn.modules.linear": "Identity",
    **{
        f"torch.optim.{name.lower()}": name
        for name in ("Adadelta", "Adagrad", "Adam", "Adamax", "AdamW", "ASGD", "NAdam", "RAdam", "RMSprop", "SGD")
    },
}
"""What models and statistics are made of: making these objects does nothing else. All else may run code."""
_FOR_TRAINING = {
    "learning_rate": 0.0,
    "lr_schedule": None,
    "clip_range": 0.2,
    "clip_range_vf": None,
    "exploration_schedule": None,
    "delta_std_schedule": None,
    "weights": None,
    "buffer_size": 1,
}
"""Of a model, what only its training reads, and what stands for it where a model only acts: often functions, which
Stable-Baselines3 keeps as code, tensors, and room for a replay buffer."""
ALGORITHMS = {
    **dict.fromkeys(("PPO", "A2C", "DQN"), "stable_baselines3"),
    **dict.fromkeys(("RecurrentPPO", "MaskablePPO", "TRPO", "QRDQN", "ARS"), "sb3_contrib"),
}
"""Those that can choose among six actions, and the packages that have them."""
# A file does not name its algorithm: the module of its policy does, or what only that algorithm has.
_BY_POLICY = {
    "sb3_contrib.common.recurrent.": "RecurrentPPO",
    "sb3_contrib.common.maskable.": "MaskablePPO",
    "sb3_contrib.ars.": "ARS",
}
_BY_KEY = {
    "cg_damping": "TRPO",
    "clip_range": "PPO",
    "gae_lambda": "A2C",
    "n_quantiles": "QRDQN",
    "exploration_fraction": "DQN",
}
_PLAIN_TYPE = re.compile(r"[biufcSUO]\d+")
_PICKLED = ":serialized:"
_CHECKPOINT = re.compile(r"(?P<name>.+)_(?P<steps>\d+)_steps")
# Of the last reset before normalisation; Stable-Baselines3 keeps it only where the environment is normalised.
_TELLS_NORMALISED = "_last_original_obs"
# Off-policy algorithms, which have none, keep it always.
_ON_POLICY = "gae_lambda"


class _Nothing:
    """Stands for an object of a pickle: whatever is done to it does nothing."""

    def __new__(cls, *_: Any, **__: Any) -> Self:
        return super().__new__(cls)

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any) -> Self:
        return self

    def __setitem__(self, key: Any, value: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        # Of exactly two arguments: where a pickle means the class itself, whose state would last, it fails.
        pass

    append = extend = __setstate__


class _NumpyType(_Nothing):
    """Stands for a `numpy.dtype`: one that lies about its numbers lets NumPy follow forged addresses."""

    def __init__(self, code: Any, *_: Any) -> None:
        if not (isinstance(code, str) and _PLAIN_TYPE.fullmatch(code)):
            raise ValueError(f"expected a plain type of numbers, got {code!r}")
        self._code = code

    def __setstate__(self, state: Any) -> None:
        if state != np.dtype(self._code).newbyteorder(state[1]).__reduce__()[2]:
            raise ValueError(f"expected what NumPy says of {self._code}, got {state!r}")


class _KnownObjects(pickle.Unpickler):
    """Reads a pickle of which nothing is made; only the names in it are looked at."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        super().__init__(file)
        self._path = path

    def find_class(self, module: str, name: str) -> Any:
        if name in _KNOWN.get(module, "").split():
            return type(name, (_NumpyType if (module, name) == ("numpy", "dtype") else _Nothing,), {})
        raise PolicyError(
            f"{self._path}: opening it would run code that it holds or names, found {module}.{name}; if you know "
            "who made it, open it with --trusted, or once and for all: python -m avp_sb3.export --trusted"
        )


def check_harmless(path: Path, *, without: Collection[str] = ()) -> None:
    """Refuse a model (`.zip`) or statistics (`.pkl`) whose pickles could run anything but what such files consist of.

    Nothing is called and nothing made, also not to find out. Attributes of a model `without` which it is opened are
    not looked at.

    Raises:
        PolicyError: there is something else in it, or it cannot be read.
    """
    try:
        for pickled in _pickles(path, without):
            _KnownObjects(pickled, path).load()
    except PolicyError:
        raise
    except Exception as error:
        # Whatever a damaged or forged pickle comes to; it must not be opened without this check.
        raise PolicyError(f"{path}: {_expected(path)}, could not load it: {error}") from None


def _pickles(path: Path, without: Collection[str]) -> list[BinaryIO]:
    if path.suffix != ".zip":
        return [io.BytesIO(path.read_bytes())]
    values = [value for key, value in _data(path).items() if key not in without]
    pickled = [value[_PICKLED] for value in values if isinstance(value, dict) and _PICKLED in value]
    return [io.BytesIO(base64.b64decode(each)) for each in pickled]


def _expected(path: Path) -> str:
    if path.suffix == ".pkl":
        return "expected the statistics of Stable-Baselines3's VecNormalize"
    return f"expected a model of Stable-Baselines3 or sb3-contrib ({', '.join(ALGORITHMS)})"


def algorithm_of(path: Path) -> str:
    """One of `ALGORITHMS`, by a model's file; its pickles are not opened.

    Raises:
        PolicyError: it is of none of them, or does not tell.
    """
    data = _data(path)
    try:
        module = str(data["policy_class"]["__module__"])
    except (KeyError, TypeError) as error:
        raise PolicyError(f"{path}: {_expected(path)}, could not load it: {error}") from None
    told = [name for start, name in _BY_POLICY.items() if module.startswith(start)]
    told += [name for key, name in _BY_KEY.items() if key in data]
    if not told:
        raise PolicyError(f"{path}: {_expected(path)}, found one of {module}; if it is, say which, as PPO:{path}")
    return told[0]


def load_model(path: Path, *, env: Any = None, trusted: bool = False, algorithm: str | None = None) -> Any:
    """A model of Stable-Baselines3 or sb3-contrib, on the CPU.

    Args:
        path: of its `.zip`.
        env: in which its training goes on; without it, what only training needs is left unread.
        trusted: open it also where that may run code which the file holds.
        algorithm: one of `ALGORITHMS`; what the file tells when omitted.

    Raises:
        PolicyError: it is none, needs a package that is not installed, or holds what may run code.
        ValueError: it does not fit `env`.
    """
    kind = _algorithm(path, algorithm or algorithm_of(path))
    replaced = _FOR_TRAINING if env is None and not trusted else {}
    if not trusted:
        check_harmless(path, without=replaced)
    try:
        return kind.load(path, env=env, device="cpu", custom_objects=replaced)
    except Exception as error:
        if env is not None and isinstance(error, ValueError):
            raise
        # A pickle may raise anything.
        raise PolicyError(f"{path}: expected a model of {kind.__name__}, could not load it: {error}") from None


def _algorithm(path: Path, name: str) -> Any:
    package = ALGORITHMS[name]
    try:
        return getattr(importlib.import_module(package), name)
    except ImportError:
        install = "'avp-suite[sb3]'" if package == "stable_baselines3" else package.replace("_", "-")
        raise PolicyError(f"{path}: {name} needs {package}; install it with `pip install {install}`") from None


def is_normalised(path: Path) -> bool | None:
    """Whether a model (`.zip`) was trained under `VecNormalize`; its pickles are not opened.

    None where the file does not tell: off-policy algorithms and ARS.
    """
    try:
        data = _data(path)
    except PolicyError:
        return False
    return data.get(_TELLS_NORMALISED) is not None if _ON_POLICY in data else None


def _data(path: Path) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(path) as archive:
            return json.loads(archive.read("data"))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise PolicyError(f"{path}: {_expected(path)}, could not load it: {error}") from None


def statistics_names(path: Path) -> list[Path]:
    """Where the statistics that belong to a model may lie, the likeliest first.

    Beside `NAME.zip` these are `NAME_vecnormalize.pkl` (ours), for `NAME_10_steps.zip` `NAME_vecnormalize_10_steps.pkl`
    (CheckpointCallback), `ENV/vecnormalize.pkl` in a folder `ENV_1` (rl_zoo3), and `vec_normalize.pkl` or
    `vecnormalize.pkl` (SB3's examples, Hugging Face).
    """
    folder, found = path.parent, [path.with_name(f"{path.stem}_vecnormalize.pkl")]
    if steps := _CHECKPOINT.fullmatch(path.stem):
        found.append(path.with_name(f"{steps['name']}_vecnormalize_{steps['steps']}_steps.pkl"))
    run = folder.resolve().name
    ends = reversed([match.start() for match in re.finditer(r"_\d+(?=_|$)", run)])
    found += [folder / run[:end] / "vecnormalize.pkl" for end in ends]
    return [*found, folder / "vec_normalize.pkl", folder / "vecnormalize.pkl"]


def statistics_of(path: Path) -> Path | None:
    """The file of the statistics that a model needs; None where it was not trained under `VecNormalize`.

    A model that does not tell was, if there are such statistics beside it.

    Raises:
        PolicyError: it was, and none of them is there.
    """
    normalised, names = is_normalised(path), statistics_names(path)
    if normalised is False:
        return None
    found = next((name for name in names if name.is_file()), None)
    if found is not None or normalised is None:
        return found
    raise PolicyError(
        f"{path}: trained under VecNormalize, without whose statistics it acts blindly; expected one of "
        f"{', '.join(map(str, dict.fromkeys(names)))}"
    )


def load_statistics(path: Path, space: Any, *, trusted: bool = False) -> Any:
    """The `VecNormalize` of a model for observations of a space, without an environment.

    Raises:
        PolicyError: it holds what may run code and is not `trusted`, something else, or the statistics of other
            observations.
    """
    from stable_baselines3.common.vec_env import VecNormalize

    if not trusted:
        check_harmless(path)
    try:
        with path.open("rb") as file:
            found = pickle.load(file)
    except Exception as error:
        # A pickle may raise anything.
        raise PolicyError(f"{path}: {_expected(path)}, could not load it: {error}") from None
    if not isinstance(found, VecNormalize):
        raise PolicyError(f"{path}: {_expected(path)}, found {type(found).__name__}")
    if found.observation_space.shape != space.shape:
        raise PolicyError(
            f"{path}: {_expected(path)} for observations of shape {space.shape}, found those for "
            f"{found.observation_space.shape}"
        )
    return found


class NormalisedPolicy:
    """A model that sees observations as in its training under `VecNormalize`."""

    def __init__(self, model: Any, statistics: Path, *, trusted: bool = False) -> None:
        """Join a model and the file of its statistics; errors are those of `load_statistics`."""
        self._model, self._statistics = model, load_statistics(statistics, model.observation_space, trusted=trusted)
        self.avp_mlflow_run_id = getattr(model, "avp_mlflow_run_id", None)

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, Any]:
        """Actions for observations as the environment gives them."""
        return self._model.predict(self._statistics.normalize_obs(observation), state, episode_start, deterministic)

    def set_random_seed(self, seed: int) -> None:
        """Seed the draws of actions."""
        self._model.set_random_seed(seed)
