"""`python -m avp_sb3.rerun ROLLOUT … --out FILE`: write rollouts side by side to one Rerun recording."""

import sys
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from avp_habitat import command
from avp_habitat.files import check_new
from avp_sb3.rerun.importer import rollouts_at


@dataclass(frozen=True)
class Record:
    """Write rollouts side by side to one recording; open it with `rerun FILE`."""

    rollouts: Positional[tuple[Path, ...]]
    """Rollout folders, or folders of rollouts."""
    out: Path
    """The .rrd file to make; must not exist."""


def main(options: Record) -> None:
    """Write the recording, say how large it is."""
    check_new(options.out, option="--out")
    from avp_sb3.rerun.rollout import write_rollout_recording

    folders = [folder for path in options.rollouts for folder in rollouts_at(path) or [path]]
    target = write_rollout_recording(folders, options.out, progress=True)
    print(f"{target}: {len(folders)} rollout{'s' * (len(folders) > 1)}, {target.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    sys.exit(command.run(main))
