"""The policy of a running training on other scenes: figures, pictures, and the best model kept."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Image, Logger
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.errors import UsageError
from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.task.settings import TaskSettings
from avp_sb3.callbacks.base import NOT_FOR, LoggedFile, MissingInfoError, is_learning, record
from avp_sb3.callbacks.best_model import WHEN, BestModel, statistics_of
from avp_sb3.evaluation.batch import READER, check_fit, means, own_random_state, run_batch, scenes_of
from avp_sb3.evaluation.picture import evaluation_picture
from avp_sb3.evaluation.policy import Episode
from avp_sb3.vec_env.batched import AVPVecEnv
from avp_sb3.vec_env.subproc import AVPSubprocVecEnv

DEFAULT_SCENES = ("builtin:7",)
DEFAULT_EVERY, DEFAULT_EPISODES = 150_000, 10
"""About 0.7 % of a training with Table 4's values and tables; whoever evaluates more often pays in proportion."""
_NO_PICTURES = ("stdout", "log", "json", "csv")


class EvaluationCallback(BaseCallback):
    """Evaluates the policy on other scenes while it trains, from the same starts each time, and keeps the best model.

    One line is enough:

        model.learn(300_000, callback=[MLflowCallback(), EvaluationCallback(("builtin:7", "builtin:8"))])

    or in rl_zoo3's hyper-parameters:

        callback: [{avp_sb3.EvaluationCallback: {scenes: ["builtin:7"], every: 50000}}]

    It logs `eval/FIGURE`, the means of the figures of `avp_sb3.evaluate` and of `return` over all scenes and episodes,
    with several scenes also `eval/SCENE/FIGURE`, a picture `eval/SCENE/trajectory` (the first start's path, and
    coverage by view), and `eval/best_SCORE` with the model itself when it is better than before. The last evaluation is
    that of the finished model; an interrupted training has none. The training's environment and random numbers are not
    touched: with or without this callback the same weights come out.
    """

    def __init__(
        self,
        scenes: str | Path | Sequence[str | Path] | None = None,
        *,
        eval_env: VecEnv | None = None,
        every: int = DEFAULT_EVERY,
        episodes: int = DEFAULT_EPISODES,
        seed: int = 1000,
        deterministic: bool = False,
        at_start: bool = True,
        score: str = "return",
        best_model: str | Path | None = f"runs/best-{WHEN}.zip",
        settings: TaskSettings | None = None,
        simulator: str = "raycast",
        gpu: int | None = None,
        navmesh: str | Path | None = None,
        up: str | None = None,
        verbose: int = 1,
    ) -> None:
        """Describe the evaluation; scenes are opened when the training starts.

        Args:
            scenes: each as `avp_habitat.scenes.location.locate` takes it; `builtin:7` when omitted.
            eval_env: instead of scenes: an environment whose `info` holds `avp_episode` at the end of an episode. With
                `coverage` in every `info` there is a curve, with attributes `scene_name`, `area` and `settings` (as of
                `AVP-v0`) there are figures per scene, maps, and figures of the whole budget.
            every: environment steps of all agents together between two evaluations.
            episodes: in each scene.
            seed: episode i of a scene starts from `seed + i`, as in `avp_sb3.evaluate`; in an `eval_env` with fewer
                environments than episodes the first ones do.
            deterministic: take the likeliest actions. False samples them, which is the fairer test of a policy that
                trains with sampled ones (docs/training.md), with the same random numbers each time.
            at_start: evaluate before the first step, too, which also prepares the tables of the scenes.
            score: the figure by which the best model is chosen: `return` or another one of those logged. The least is
                best for figures of which less is better (views, collisions, redundant_share), else the greatest.
            best_model: file of the best model; `DATE-TIME` in its name becomes when the training started; None keeps
                none. A file that exists is refused unless the training that made it goes on.
            settings: of the task; those of the training's environment when omitted, also whether views are looked up.
            simulator: that opens the scenes; with `habitat` each of them is in a process of its own.
            gpu: as of `AVPVecEnv`.
            navmesh: as of `AVPVecEnv`.
            up: as of `AVPVecEnv`.
            verbose: 1 prints at the end where the best model is, 2 also when a better one is kept; 0 prints nothing.

        Raises:
            UsageError: a number, name or combination that cannot be right.
        """
        super().__init__(verbose)
        for name, value in (("every", every), ("episodes", episodes)):
            if value < 1:
                raise UsageError(f"{READER} {name}: expected at least 1, got {value}")
        self._scenes = _scenes(scenes, eval_env, settings)
        self._given, self._env = eval_env, eval_env
        self._every, self._episodes, self._seed = every, episodes, seed
        self._deterministic, self._at_start, self._score = deterministic, at_start, score
        self._settings = settings
        self._choice = SimulatorChoice(simulator, gpu=gpu, navmesh=Path(navmesh) if navmesh else None, up=up)
        self._best = BestModel(best_model, score)
        self._due = 0
        self._evaluated_at: int | None = None

    @property
    def best_model(self) -> Path | None:
        """File of the best model, known once the training has started."""
        return self._best.path

    @property
    def best(self) -> float | None:
        """The best score so far."""
        return self._best.value

    def _on_training_start(self) -> None:
        self._close()
        with own_random_state(self.model, self._seed):
            self._env = self._open() if self._given is None else self._given
        check_fit(self.model, self.training_env, self._env)
        settings = self._env.get_attr("settings", 0)[0] if self._env.has_attr("settings") else None
        self._best.start(self.model, settings.metrics if isinstance(settings, TaskSettings) else ())
        self._evaluated_at = None
        self._plan_next()
        _move_to_front(self, self.locals.get("callback"))

    def _on_rollout_start(self) -> None:
        # Not when the training starts: trackers that come later in the list are not listening yet.
        if self._at_start and self._evaluated_at is None:
            self._evaluate()

    def _on_step(self) -> bool:
        # The last evaluation comes after the last update; one within the last rollout would be the same but worse.
        if self._due <= self.num_timesteps < self.model._total_timesteps:
            self._evaluate()
            self._plan_next()
        return True

    def _on_training_end(self) -> None:
        self.num_timesteps = self.model.num_timesteps
        if is_learning(self.model) and self._evaluated_at != self.num_timesteps:
            self._evaluate()
        self._close()
        if self.verbose and self.best_model is not None and self.best is not None:
            print(f"best:     {self.best_model}, {self._score} {self.best:.4g} in the evaluation", flush=True)

    def _close(self) -> None:
        if self._given is None and self._env is not None:
            self._env.close()

    def _plan_next(self) -> None:
        self._due = (self.num_timesteps // self._every + 1) * self._every

    def _open(self) -> VecEnv:
        settings = self._settings
        if settings is None:
            env = self.training_env
            settings = env.get_attr("settings", 0)[0] if env.has_attr("settings") else None
            if not isinstance(settings, TaskSettings):
                raise UsageError(
                    f"{READER}: the training's environment has no settings of AVP-v0 to evaluate with; expected "
                    "settings, or an eval_env of its own kind"
                )
            # Only rays can be looked up.
            settings = replace(settings, lookup=settings.lookup and self._choice.single_rays)
        vec_env = AVPSubprocVecEnv if self._choice.one_per_process else AVPVecEnv
        agents = self._episodes * len(self._scenes)
        return vec_env(self._scenes, agents=agents, settings=settings, **vars(self._choice))

    def _evaluate(self) -> None:
        assert self._env is not None
        with own_random_state(self.model, self._seed):
            found = run_batch(self.model, self._env, self._episodes, seed=self._seed, deterministic=self._deterministic)
        self._evaluated_at = self.num_timesteps
        # A logger of its own with the same outputs: SB3's EvalCallback would dump what the training has recorded so
        # far, half of a rollout's figures and the last update's losses.
        logger = Logger(None, self.logger.output_formats)
        self._record(logger, found)
        logger.record("time/total_timesteps", self.num_timesteps, exclude=("tensorboard", "mlflow"))
        logger.dump(self.num_timesteps)

    def _record(self, logger: Logger, found: dict[str, list[Episode]]) -> None:
        figures = means([episode for episodes in found.values() for episode in episodes])
        for name, value in figures.items():
            record(logger, f"eval/{name}", value)
        for scene, episodes in found.items():
            for name, value in means(episodes).items() if len(found) > 1 else ():
                record(logger, f"eval/{scene}/{name}", value)
            logger.record(f"eval/{scene}/trajectory", self._picture(scene, episodes), exclude=_NO_PICTURES)
        if self._score not in figures:
            raise MissingInfoError(
                f"{READER} score {self._score!r}: needs 'coverage' in every info and the attribute 'settings' of "
                f"AVP-v0; this environment gives {', '.join(sorted(figures))}"
            )
        if self._best.offer(self.model, figures[self._score]):
            self._record_best(logger, figures[self._score])

    def _picture(self, scene: str, episodes: Sequence[Episode]) -> Image:
        assert self._env is not None
        first = scenes_of(self._env)[scene][0]
        area = self._env.get_attr("area", first)[0] if self._env.has_attr("area") else None
        curves = [episode.curve for episode in episodes]
        return Image(evaluation_picture(curves, area, episodes[0].trajectory), "HWC")

    def _record_best(self, logger: Logger, value: float) -> None:
        logger.record(f"eval/best_{self._score}", value)
        path = self._best.path
        if path is None:
            return
        logger.record("eval/best_model", LoggedFile(path, "best_model.zip"), exclude=NOT_FOR)
        if self.model.get_vec_normalize_env() is not None:
            file = LoggedFile(statistics_of(path), "best_model_vecnormalize.pkl")
            logger.record("eval/best_model_vecnormalize", file, exclude=NOT_FOR)
        if self.verbose > 1:
            print(f"{path}: the best model so far, {self._score} {value:.4g} after {self.num_timesteps} steps")


def _scenes(
    scenes: str | Path | Sequence[str | Path] | None, env: VecEnv | None, settings: TaskSettings | None
) -> list[str]:
    if env is not None:
        for name, value in (("scenes", scenes), ("settings", settings)):
            if value is not None:
                raise UsageError(f"{READER}: expected {name} or eval_env, got both")
        return []
    given = DEFAULT_SCENES if scenes is None else [scenes] if isinstance(scenes, (str, Path)) else scenes
    found = list(map(str, given))
    if not found:
        raise UsageError(f"{READER} scenes: expected at least one, got none")
    if repeated := {scene for scene in found if found.count(scene) > 1}:
        raise UsageError(f"{READER} scenes: expected each once, got {', '.join(sorted(repeated))} again")
    return found


def _move_to_front(callback: BaseCallback, whole: Any) -> bool:
    """Let a callback of `whole` come first: trackers close at the end of the training, and its last figures come then.

    The lists that the caller made stay as they are.
    """
    for part in whole.callbacks if isinstance(whole, CallbackList) else ():
        if _move_to_front(callback, part):
            whole.callbacks = [part, *(other for other in whole.callbacks if other is not part)]
            return True
    return whole is callback
