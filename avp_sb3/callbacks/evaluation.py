"""The policy of a running training on other scenes: figures, pictures, and the best model kept."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Image, Logger
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.errors import UsageError
from avp_habitat.policies.saved_model import statistics_names
from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.task.settings import TaskSettings
from avp_sb3.callbacks.base import NOT_FOR, LoggedFile, MissingInfoError, is_learning, record, settings_of
from avp_sb3.callbacks.best_model import WHEN, BestModel
from avp_sb3.evaluation.batch import READER, check_fit, means, own_random_state, run_batch, scenes_of
from avp_sb3.evaluation.picture import evaluation_picture
from avp_sb3.evaluation.policy import Episode
from avp_sb3.vec_env.batched import AVPVecEnv, Scenes, scenes_given
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
    that of the finished model. With or without this callback the same weights come out.
    """

    def __init__(
        self,
        scenes: Scenes | None = None,
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
            settings: of the task; those of the training's environment when omitted.
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
        for name, value in (("scenes", scenes), ("settings", settings)):
            if eval_env is not None and value is not None:
                raise UsageError(f"{READER}: expected {name} or eval_env, got both")
        self._scenes = DEFAULT_SCENES if scenes is None else scenes
        self._given, self._env = eval_env, eval_env
        self._every, self._episodes, self._seed = every, episodes, seed
        self._deterministic, self._at_start, self._score = deterministic, at_start, score
        self._settings = settings
        self._choice = SimulatorChoice(simulator, gpu=gpu, navmesh=Path(navmesh) if navmesh else None, up=up)
        self._best = BestModel(best_model, score)
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
        settings = settings_of(self._env)
        self._best.start(self.model, () if settings is None else settings.metrics)
        self._evaluated_at = None
        self._intervals = self.num_timesteps // self._every
        _move_to_front(self, self.locals.get("callback"))

    def _on_rollout_start(self) -> None:
        # Not when the training starts: trackers that come later in the list are not listening yet.
        if self._at_start and self._evaluated_at is None:
            self._evaluate()

    def _on_step(self) -> bool:
        # The last evaluation comes after the last update; one within the last rollout would be the same but worse.
        is_due = self.num_timesteps // self._every > self._intervals
        if is_due and self.num_timesteps < self.model._total_timesteps:
            self._evaluate()
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

    def _open(self) -> VecEnv:
        settings = self._settings or settings_of(self.training_env)
        if settings is None:
            raise UsageError(f"{READER}: the training has no settings of AVP-v0; expected settings, or an eval_env")
        # Only rays can be looked up.
        settings = replace(settings, lookup=settings.lookup and self._choice.single_rays)
        vec_env = AVPSubprocVecEnv if self._choice.one_per_process else AVPVecEnv
        scenes = scenes_given(self._scenes, self._choice)
        return vec_env(scenes, agents=self._episodes * len(scenes), settings=settings, **vars(self._choice))

    def _evaluate(self) -> None:
        assert self._env is not None
        with own_random_state(self.model, self._seed):
            found = run_batch(self.model, self._env, self._episodes, seed=self._seed, deterministic=self._deterministic)
        self._evaluated_at = self.num_timesteps
        self._intervals = self.num_timesteps // self._every
        # A logger of its own with the same outputs: the training's would dump half of a rollout's figures.
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
            found_figures = ", ".join(sorted(figures))
            raise MissingInfoError(f"{READER} score {self._score!r}: this environment gives only {found_figures}")
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
        if (path := self._best.path) is None:
            return
        logger.record("eval/best_model", LoggedFile(path, "best_model.zip"), exclude=NOT_FOR)
        if self.model.get_vec_normalize_env() is not None:
            file = LoggedFile(statistics_names(path)[0], "best_model_vecnormalize.pkl")
            logger.record("eval/best_model_vecnormalize", file, exclude=NOT_FOR)
        if self.verbose > 1:
            print(f"{path}: the best model so far, {self._score} {value:.4g} after {self.num_timesteps} steps")


def _move_to_front(callback: BaseCallback, whole: Any) -> bool:
    """Let a callback of `whole` come first: trackers close at the training's end, and its last figures come then."""
    for part in whole.callbacks if isinstance(whole, CallbackList) else ():
        if _move_to_front(callback, part):
            whole.callbacks = [part, *(other for other in whole.callbacks if other is not part)]
            return True
    return whole is callback
