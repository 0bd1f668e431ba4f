"""Names of the tags that runs and experiments have, and names and lengths that MLflow takes."""

import itertools
import re

KIND_TAG = "avp.kind"
"""training, rollout, reconstruction, evaluation, comparison, experiment."""
POLICY_TAG, SCENE_TAG, METHOD_TAG = "avp.policy", "avp.scene", "avp.method"
DIGEST_TAG, SIMULATOR_TAG = "avp.scene_digest", "avp.simulator"
ROLLOUT_TAG, ROLLOUT_ID_TAG = "avp.rollout", "avp.rollout_id"
POLICY_RUN_TAG, ROLLOUT_RUN_TAG = "avp.policy_run", "avp.rollout_run"
"""The run that trained the policy, and that of the rollout which a reconstruction is made from."""
CONTINUED_TAG, RESUMED_TAG = "avp.continued_from", "avp.resumed_at_step"
KEY_TAG, RENAMED_TAG, CHANGED_TAG = "avp.key", "avp.renamed", "avp.changed_params"
VIEWS_TAG = "avp.views"
"""Of an experiment whose page has been prepared."""
PARENT_TAG, NOTE_TAG, COLOUR_TAG = "mlflow.parentRunId", "mlflow.note.content", "mlflow.runColor"
IMAGES_TAG, VIEW_TAG, PAGE_TAG = "mlflow.loggedImages", "mlflow.sharedViewState.", "mlflow.experimentKind"

ROLLOUT, RECONSTRUCTION, COMPARISON, EVALUATION = "rollout", "reconstruction", "comparison", "evaluation"
"""Values of `avp.kind`."""
OFFLINE = "offline-"
"""How the ids of runs begin that MLflow does not know yet; the key of their journal follows."""

MAX_NAME, MAX_PARAM, MAX_TAG = 250, 6000, 5000
"""Characters that MLflow takes."""
_BRACKETS, _UNSAFE = re.compile(r"[()\[\]{}]"), re.compile(r"[^\w.\- /]")


def safe_name(name: str) -> str:
    """A name that MLflow takes on every system and with every store.

    Brackets go, and empty and dotted parts of a path; what is no letter, digit, `_ . -`, space or `/` becomes `_`.
    """
    parts = (part.strip() for part in _UNSAFE.sub("_", _BRACKETS.sub("", name)).split("/"))
    return "/".join(part for part in parts if part not in ("", ".", ".."))[:MAX_NAME].rstrip("/ ") or "_"


class SafeNames(dict[str, str]):
    """The safe names of one run by name: each has its own, also where two differ only in what MLflow refuses."""

    def __missing__(self, name: str) -> str:
        """Choose one, with a number where it is taken."""
        safe = safe_name(name)
        numbered = (f"{safe[: MAX_NAME - 4]} {count}" for count in itertools.count(2))
        self[name] = next(one for one in itertools.chain([safe], numbered) if one not in self.values())
        return self[name]

    @property
    def changed(self) -> dict[str, str]:
        """Those that MLflow refuses."""
        return {name: safe for name, safe in self.items() if name != safe}
