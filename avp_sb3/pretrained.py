"""`python -m avp_sb3.pretrained`: the weights that lie in the package."""

import sys
from dataclasses import dataclass

from avp_habitat import command
from avp_habitat.policies.weights import DEFAULT, PRETRAINED, available
from avp_habitat.policies.weights.format import read_weights
from avp_habitat.tables import table


@dataclass(frozen=True)
class Pretrained:
    """List the weights of the package: what `--policy pretrained:NAME` and `--start NAME` take."""


def main(options: Pretrained) -> None:
    """Read all of them, which checks them, and print a line each."""
    there = available()
    if not there:
        print("this copy of avp-suite has no pretrained weights; `python -m avp_sb3.export` makes some of a model")
        return
    head, rows = ("policy", "version", "observation", "inputs", "steps", "SHA-256"), []
    for name, path in there.items():
        weights = read_weights(path)
        steps = weights.training.get("steps")
        shape = "x".join(map(str, weights.shape))
        marked = f"{PRETRAINED}:{name}" + (f" (= {PRETRAINED})" if name == DEFAULT else "")
        told = "" if steps is None else f"{steps:,}"
        rows.append((marked, str(weights.version), weights.observation, shape, told, weights.sha256[:12]))
    print(table(head, rows, markdown=False))


if __name__ == "__main__":
    sys.exit(command.run(main))
