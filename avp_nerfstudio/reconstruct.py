"""`ns-train avp-nerfacto` and `ns-eval` in one process, for programs that reconstruct several rollouts.

Importing nerfstudio takes tens of seconds on a small machine; here it is paid once, not twice per rollout.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_nerfstudio.scores import Scores, read_scores


@dataclass(frozen=True)
class Reconstruction:
    """What a reconstruction left behind."""

    config: Path
    """`config.yml`, for `ns-eval`, `ns-render`, `ns-export` and `ns-viewer --load-config`."""
    scores: Scores
    """Of the held-out views."""


def reconstruct(
    data: str | Path,
    output_dir: str | Path,
    *,
    iterations: int | None = None,
    edit: Callable[[Any], None] | None = None,
) -> Reconstruction:
    """Train `avp-nerfacto` on a rollout and score it on the held-out views.

    Args:
        data: the rollout.
        output_dir: nerfstudio's folder for outputs; `scores.json` is written beside the run's `config.yml`.
        iterations: how long to train; the method's default when omitted.
        edit: changes the `TrainerConfig` before training, for settings beyond these.

    Raises:
        RolloutError: the rollout cannot be used.
    """
    # nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.
    from nerfstudio.scripts import eval as ns_eval
    from nerfstudio.scripts import train as ns_train
    from nerfstudio.utils import writer

    from avp_nerfstudio.config import trainer_config

    config = trainer_config()
    config.data, config.output_dir = Path(data), Path(output_dir)
    if iterations is not None:
        config.max_num_iterations = iterations
    if edit is not None:
        edit(config)
    # nerfstudio keeps its writers for the life of a process: the last run's log must not get this run's events.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    ns_train.main(config)
    run = config.get_base_dir()
    ns_eval.ComputePSNR(load_config=run / "config.yml", output_path=run / "scores.json").main()
    return Reconstruction(run / "config.yml", read_scores(run / "scores.json"))
