"""The policy of a running training on other scenes: figures, pictures, and the best model kept."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Image
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.errors import UsageError, unknown_name
from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.task.settings import TaskSettings
from avp_sb3.callbacks.base import NOT_FOR, LoggedFile, MissingInfoError, is_learning, logged_alone, move_to_front
from avp_sb3.callbacks.best_model import WHEN, BestModel, statistics_of
from avp_sb3.evaluation.batch import (
    FIGURES,
    READER,
    BatchEpisode,
    fixed_starts,
    means,
    own_random_state,
    run_batch,
    scenes_of,
)
from avp_sb3.evaluation.fit import check_fit, normalised_like
from avp_sb3.evaluation.picture import evaluation_picture

DEFAULT_SCENES = ("builtin:7",)
DEFAULT_EVERY, DEFAULT_EPISODES = 150_000, 10
"""About 0.7 % of a training with Table 4's values and tables; whoever evaluates more often pays in proportion."""
_SCREEN = ("stdout", "log")
_NO_PICTURES = (*_SCREEN, "json", "csv")
_LONGEST_SCENE = 18
"""Letters of a scene's name on the screen: SB3 cuts names at 36 and refuses two that it cut to the same."""


class EvaluationCallback(BaseCallback):
    """Evaluates the policy on other scenes while it trains, from the same starts each time, and keeps the best model.

    One line is enough:

        model.learn(300_000, callback=[MLflowCallback(), EvaluationCallback(("builtin:7", "builtin:8"))])

    or in rl_zoo3's hyper-parameters:

        callback: [{avp_sb3.EvaluationCallback: {scenes: ["builtin:7"], every: 50000}}]

    It logs `eval/coverage`, `eval/views`, `eval/cpv`, `eval/annd_m`, `eval/ei`, `eval/coverage_area`, `eval/return` and
    the other figures of `avp_sb3.evaluate` (means over all scenes and episodes), per scene `eval/SCENE/coverage` … when
    there are several, a picture `eval/SCENE/trajectory` (the first start's path, and coverage by view), and
    `eval/best_SCORE` with the model itself when it is better than before. The last evaluation is that of the finished
    model; an interrupted training has none. The training's environment and random numbers are not touched: with or
    without this callback the same weights come out.
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
            eval_env: instead of scenes: an environment of its own whose `info` holds `avp_episode` at the end of an
                episode. With `coverage` in every `info` there is a curve, with attributes `scene_name`, `area` and
                `settings` (those of `AVP-v0`) there are figures per scene, maps, and figures of the whole budget.
            every: environment steps of all agents together between two evaluations.
            episodes: in each scene.
            seed: episode i of a scene starts from `seed + i`, as in `avp_sb3.evaluate`. An `eval_env` with fewer
                environments than episodes has this only for the first ones; the others follow from them.
            deterministic: take the likeliest actions. False samples them, which is the fairer test of a policy that
                trains with sampled ones (docs/training.md), with the same random numbers each time.
            at_start: evaluate before the first step, too, which also prepares the tables of the scenes.
            score: the figure by which the best model is chosen: `return` or another one of those logged. The least is
                best for views, path_length_m, collisions and redundant_share, the greatest for all others.
            best_model: file of the best model; `DATE-TIME` in its name becomes when the training started; None keeps
                none. A file that exists is refused unless the training that made it goes on.
            settings: of the task; those of the training's environment when omitted, also whether views are looked up.
            simulator: that opens the scenes; with `habitat` each of them is in a process of its own.
            gpu: the CUDA device of `habitat`; -1 for none, None for the first one there is.
            navmesh: file of the only scene's NavMesh; computed when omitted.
            up: axis of mesh files that points up, `y` or `z`; of each file what is known of it when omitted.
            verbose: 1 prints at the end where the best model is, 2 also when a better one is kept; 0 prints nothing.

        Raises:
            UsageError: a number, name or combination that cannot be right.
        """
        super().__init__(verbose)
        for name, value in (("every", every), ("episodes", episodes)):
            if value < 1:
                raise UsageError(f"{READER} {name}: expected at least 1, got {value}")
        if score not in FIGURES:
            raise unknown_name("score", score, FIGURES)
        self._scenes = _scenes(scenes, eval_env, settings)
        self._given, self._env = eval_env, eval_env
        self._agents: dict[str, list[int]] = {}
        self._every, self._episodes, self._seed = every, episodes, seed
        self._deterministic, self._at_start, self._score = deterministic, at_start, score
        self._settings = settings
        self._choice = SimulatorChoice(simulator, gpu=gpu, navmesh=navmesh and Path(navmesh), up=up)
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
        check_fit(self.model, self.training_env, self._env, reader=READER)
        self._agents = scenes_of(self._env)
        self._best.start(self.model)
        self._evaluated_at = None
        self._plan_next()
        move_to_front(self, self.locals.get("callback"))

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
        return fixed_starts(self._scenes, self._choice, episodes=self._episodes, settings=settings)

    def _evaluate(self) -> None:
        assert self._env is not None
        quota = {agent: count for agents in self._agents.values() for agent, count in _spread(agents, self._episodes)}
        with own_random_state(self.model, self._seed), normalised_like(self.model, self._env):
            episodes = run_batch(self.model, self._env, quota, seed=self._seed, deterministic=self._deterministic)
        self._evaluated_at = self.num_timesteps
        with logged_alone(self):
            self._record(episodes)

    def _record(self, episodes: Sequence[BatchEpisode]) -> None:
        figures = means(episodes)
        for name, value in figures.items():
            self.logger.record(f"eval/{name}", value)
        for scene, agents in self._agents.items():
            own = [episode for episode in episodes if episode.agent in agents]
            if len(self._agents) > 1:
                exclude = _SCREEN if len(scene) > _LONGEST_SCENE else None
                for name, value in means(own).items():
                    self.logger.record(f"eval/{scene}/{name}", value, exclude)
            self.logger.record(f"eval/{scene}/trajectory", Image(self._picture(own), "HWC"), exclude=_NO_PICTURES)
        if self._score not in figures:
            raise MissingInfoError(
                f"{READER} score {self._score!r}: needs 'coverage' in every info and the attribute 'settings' of "
                f"AVP-v0; this environment gives {', '.join(sorted(figures))}"
            )
        if self._best.offer(self.model, figures[self._score]):
            self._record_best(figures[self._score])

    def _picture(self, episodes: Sequence[BatchEpisode]) -> Any:
        assert self._env is not None
        first = episodes[0]
        area = self._env.get_attr("area", first.agent)[0] if self._env.has_attr("area") else None
        return evaluation_picture([episode.curve for episode in episodes], area, first.trajectory)

    def _record_best(self, value: float) -> None:
        self.logger.record(f"eval/best_{self._score}", value)
        path = self._best.path
        if path is None:
            return
        self.logger.record("eval/best_model", LoggedFile(path, "best_model.zip"), exclude=NOT_FOR)
        statistics = statistics_of(path)
        if self.model.get_vec_normalize_env() is not None:
            file = LoggedFile(statistics, "best_model_vecnormalize.pkl")
            self.logger.record("eval/best_model_vecnormalize", file, exclude=NOT_FOR)
        if self.verbose > 1:
            print(f"{path}: the best model so far, {self._score} {value:.4g} after {self.num_timesteps} steps")


def _scenes(
    scenes: str | Path | Sequence[str | Path] | None, env: VecEnv | None, settings: TaskSettings | None
) -> tuple[str, ...]:
    if env is None:
        given = DEFAULT_SCENES if scenes is None else [scenes] if isinstance(scenes, (str, Path)) else scenes
        found = tuple(map(str, given))
        if not found:
            raise UsageError(f"{READER} scenes: expected at least one, got none")
        if repeated := {scene for scene in found if found.count(scene) > 1}:
            raise UsageError(f"{READER} scenes: expected each once, got {', '.join(sorted(repeated))} again")
        return found
    for name, value in (("scenes", scenes), ("settings", settings)):
        if value is not None:
            raise UsageError(f"{READER}: expected {name} or eval_env, got both")
    return ()


def _spread(agents: Sequence[int], episodes: int) -> list[tuple[int, int]]:
    """How many episodes each of some environments runs: as equal as can be, more at first."""
    return [(agent, (episodes + len(agents) - 1 - place) // len(agents)) for place, agent in enumerate(agents)]
