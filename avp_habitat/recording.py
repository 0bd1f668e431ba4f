"""Recording the episodes of any program that steps `AVP-v0` as rollout folders."""

import multiprocessing
import os
import sys
import weakref
from contextlib import ExitStack
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium

from avp_habitat.errors import AVPError, UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.capture import VIEWS, capture_heldout, capture_step, publish_rollout
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.task.env import AVPEnv

_PICTURE = (640, 480)


class RecordRollout(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Writes the first finished episodes as rollout folders and changes nothing else.

    An episode that is abandoned (by another `reset` or by `close`) leaves no folder.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        folder: str | Path,
        *,
        episodes: int = 1,
        heldout: int = VIEWS,
        width: int = _PICTURE[0],
        height: int = _PICTURE[1],
        policy: str = "not named",
    ) -> None:
        """Wrap an environment.

        Args:
            env: an `AVPEnv`, also a wrapped one.
            folder: of the first episode; the k-th later one goes to `FOLDER-k`, counted from 2. None may exist.
            episodes: how many to record, at least 1.
            heldout: number of held-out views in each folder.
            width: of the pictures in pixels.
            height: of the pictures in pixels.
            policy: what `rollout.json` calls the policy; the environment cannot know it.

        Raises:
            UsageError: not an `AVPEnv`, fewer than one episode, pictures of no size, or a folder exists.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, folder=folder, episodes=episodes, heldout=heldout, width=width, height=height, policy=policy
        )
        super().__init__(env)
        if not isinstance(env.unwrapped, AVPEnv):
            raise UsageError(f"RecordRollout: expected an AVPEnv, got {type(env.unwrapped).__name__}")
        for name, value in (("episodes", episodes), ("width", width), ("height", height)):
            if value < 1:
                raise UsageError(f"RecordRollout: {name}: expected at least 1, got {value}")
        self._avp = env.unwrapped
        self._camera = Intrinsics.from_hfov(width, height, hfov_deg=self._avp.settings.hfov_deg)
        self._heldout = heldout
        self._policy = policy
        self._targets = [_numbered(Path(folder), number) for number in range(1, episodes + 1)]
        for target in self._targets:
            RolloutWriter(target, self._camera)  # Refuses a folder that exists, before any episode was run.
        self._seed: int | None = None
        self._writer: RolloutWriter | None = None
        self._open = ExitStack()
        # Programs that never call close() leave no temporary folder either.
        weakref.finalize(self, self._open.close)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, recorded if there are folders left to write."""
        self._open.close()
        self._writer = None
        answer = self.env.reset(seed=seed, options=options)
        self._seed = seed
        if self._targets:
            self._writer = self._open.enter_context(RolloutWriter(self._targets[0], self._camera))
        return answer

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Do one action and record its view."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._writer is not None:
            try:
                self._record(self._writer, int(action), float(reward), info, ended=terminated or truncated)
            except BaseException:
                # The writer removes what it has written, and says it when the disk was at fault.
                self._writer = None
                self._open.__exit__(*sys.exc_info())
                raise
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Drop an unfinished recording and close the environment."""
        self._open.close()
        self._writer = None
        super().close()

    def _record(self, writer: RolloutWriter, action: int, reward: float, info: dict[str, Any], *, ended: bool) -> None:
        capture_step(self._avp, writer, action, reward, info)
        if not ended:
            return
        capture_heldout(self._avp, writer, self._heldout)
        publish_rollout(
            self._avp,
            writer,
            info,
            policy={"name": self._policy},
            seed=self._seed,
            heldout=self._heldout,
            mlflow_run_id=os.environ.get("MLFLOW_RUN_ID"),
        )
        episode = info["avp_episode"]
        print(f"{writer.folder}: {episode['views']:.0f} views, coverage {100 * episode['coverage']:.1f} %")
        del self._targets[0]
        self._writer = None
        self._open.close()


def make_env(*, record: str | Path | None = None, record_options: dict[str, Any] | None = None, **kwargs: Any) -> Any:
    """`AVP-v0` as gymnasium makes it: an `AVPEnv`, within a `RecordRollout` where a folder is given.

    Args:
        record: the rollout folder of the first episode; nothing is recorded when omitted.
        record_options: further arguments of `RecordRollout`, for example `{"episodes": 3}`.
        **kwargs: of `AVPEnv`.

    Raises:
        UsageError: as `AVPEnv` and `RecordRollout`, or options for a recording without a folder.
        SceneError: as `AVPEnv`.
        SimulatorError: as `AVPEnv`.
        SystemExit: instead of these in a worker of SB3's `SubprocVecEnv`, which then ends with one line.
    """
    try:
        if record is None and record_options:
            raise UsageError("record_options: expected a folder as `record` with them, got none")
        env = AVPEnv(**kwargs)
        return env if record is None else RecordRollout(env, record, **(record_options or {}))
    except AVPError as error:
        worker = getattr(multiprocessing.current_process(), "_target", None)
        if getattr(worker, "__module__", None) == "stable_baselines3.common.vec_env.subproc_vec_env":
            raise SystemExit(f"error: {error}") from None
        raise


# Gymnasium reads the render modes from the entry point.
make_env.metadata = AVPEnv.metadata  # type: ignore[attr-defined]


def _numbered(folder: Path, number: int) -> Path:
    return folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
