"""Features of a rollout's pictures and their matches, found without looking at its poses or its focal length."""

import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import RolloutError
from avp_habitat.rollout.format import Rollout
from avp_habitat.rollout.images import check_png_contents

# Longer rollouts are judged by runs of neighbouring frames, spread evenly over the walk.
MAX_FRAMES = 240
RUN_OF_FRAMES = 20
# Every frame is matched with this many that follow it, and every pair among this many frames of the walk is tried:
# an 80-frame rollout is matched exhaustively (3,160 pairs, about 10 s).
NEIGHBOURS = 5
EXHAUSTIVE_FRAMES = 80
# Walls and ceilings have little texture: a lower threshold than COLMAP's (0.0067) finds more features there.
PEAK_THRESHOLD = 0.005
MAX_FEATURES = 1024
MIN_MATCHES = 30
# Of the pairs with enough matches, the best of each frame are verified, and a bound for all of them together.
BEST_PAIRS_OF_A_FRAME = 16
VERIFY_MAX_ERROR_PX = 3.0
_THREADS = 2
_FEATURE_BATCH = 8
_PAIR_BATCH = 400


@dataclass(frozen=True)
class PairMatches:
    """What two pictures share; the first frame comes earlier in the walk than the second."""

    first: int
    """Place of the first picture in `Matches.names`."""
    second: int
    """Place of the second picture in `Matches.names`."""
    features: NDArray[np.uint32]
    """`(m, 2)` feature of the first and of the second picture, one row per match that fits an epipolar geometry."""


@dataclass(frozen=True)
class Matches:
    """Features and verified matches of a rollout's pictures, independent of its poses and intrinsics."""

    folder: Path
    """Where the pictures are."""
    names: list[str]
    """File names of the n judged pictures."""
    frames: NDArray[np.int64]
    """`(n,)` frame numbers in the rollout."""
    features: list[NDArray[np.float64]]
    """Per picture `(k, 2)` pixels: x right, y down, pixel centres at +0.5."""
    pairs: list[PairMatches]
    """Pairs with at least `MIN_MATCHES` matches."""


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's own log lines, but for errors, from the terminal."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 2
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def match_pictures(rollout: Rollout, *, workdir: Path | None = None, progress: bool = True) -> Matches:
    """SIFT on the frames of a rollout, matched pair by pair and verified by uncalibrated epipolar geometry.

    Args:
        rollout: of at most `MAX_FRAMES` frames, or else runs of its frames are taken.
        workdir: where COLMAP's database lies meanwhile; a temporary folder, removed at the end, when omitted.
        progress: show bars where the output is a terminal.

    Raises:
        RolloutError: a picture is damaged or cannot be read.
    """
    frames = _choose_frames(len(rollout.frames))
    paths = [rollout.frames[index].image for index in frames]
    for path in paths:
        # COLMAP goes on with the part of a damaged picture that it could decode.
        check_png_contents(path)
    folder = paths[0].parent if paths else rollout.folder
    names = [path.name for path in paths]
    with quiet_colmap(), tempfile.TemporaryDirectory(dir=workdir, prefix="pictures-") as scratch:
        database = Path(scratch) / "database.db"
        features = _extract(database, folder, names, progress=progress)
        pairs = _candidates(len(names))
        raw = _match(database, names, pairs, progress=progress)
    return Matches(folder, names, frames, features, _verify(features, _best(raw), progress=progress))


def _choose_frames(count: int) -> NDArray[np.int64]:
    """All frames, or evenly spread runs of neighbours when there are too many."""
    if count <= MAX_FRAMES:
        return np.arange(count)
    starts = np.linspace(0, count - RUN_OF_FRAMES, MAX_FRAMES // RUN_OF_FRAMES).astype(int)
    return np.unique(starts[:, None] + np.arange(RUN_OF_FRAMES))


def _candidates(count: int) -> list[tuple[int, int]]:
    """Neighbours in the walk, and all pairs among an evenly spread part of the frames."""
    near = {(i, i + step) for i in range(count) for step in range(1, NEIGHBOURS + 1) if i + step < count}
    part = range(0, count, -(-count // EXHAUSTIVE_FRAMES) or 1)
    return sorted(near | {(i, j) for i in part for j in part if i < j})


def _bar(total: int, text: str, unit: str, *, progress: bool) -> tqdm:
    return command.progress(total=total, desc=text, unit=unit, disable=not progress)


def _extract(database: Path, folder: Path, names: list[str], *, progress: bool) -> list[NDArray[np.float64]]:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = _THREADS
    options.use_gpu = False
    options.sift.peak_threshold = PEAK_THRESHOLD
    options.sift.max_num_features = MAX_FEATURES
    with _bar(len(names), "features of the pictures", "picture", progress=progress) as bar:
        for start in range(0, len(names), _FEATURE_BATCH):
            batch = names[start : start + _FEATURE_BATCH]
            pycolmap.extract_features(
                database,
                folder,
                batch,
                camera_mode=pycolmap.CameraMode.SINGLE,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            bar.update(len(batch))
    return _read_features(database, folder, names)


def _read_features(database: Path, folder: Path, names: list[str]) -> list[NDArray[np.float64]]:
    opened = pycolmap.Database.open(database)
    try:
        features = []
        for name in names:
            image = opened.read_image_with_name(name)
            if image is None:
                raise RolloutError(f"{folder / name}: expected an 8-bit RGB PNG, COLMAP could not read its pixels")
            features.append(opened.read_keypoints(image.image_id)[:, :2].astype(np.float64))
        return features
    finally:
        opened.close()


def _match(
    database: Path, names: list[str], pairs: list[tuple[int, int]], *, progress: bool
) -> list[tuple[int, int, NDArray[np.uint32]]]:
    """Nearest descriptors of every pair, `(first, second, (m, 2) features)`."""
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = _THREADS
    options.use_gpu = False
    options.skip_geometric_verification = True
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(database.with_suffix(".txt"))
    with _bar(len(pairs), "matching", "pair", progress=progress) as bar:
        for start in range(0, len(pairs), _PAIR_BATCH):
            batch = pairs[start : start + _PAIR_BATCH]
            Path(pairing.match_list_path).write_text("".join(f"{names[i]} {names[j]}\n" for i, j in batch))
            pycolmap.match_image_pairs(
                database, matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu
            )
            bar.update(len(batch))
    return _read_matches(database, names)


def _read_matches(database: Path, names: list[str]) -> list[tuple[int, int, NDArray[np.uint32]]]:
    place = {name: index for index, name in enumerate(names)}
    opened = pycolmap.Database.open(database)
    try:
        where = {image.image_id: place[image.name] for image in opened.read_all_images()}
        found = []
        for pair_id, features in zip(*opened.read_all_matches(), strict=True):
            first, second = (where[image] for image in pycolmap.pair_id_to_image_pair(pair_id))
            found.append((first, second, features) if first < second else (second, first, features[:, ::-1]))
        return found
    finally:
        opened.close()


def _best(raw: list[tuple[int, int, NDArray[np.uint32]]]) -> list[tuple[int, int, NDArray[np.uint32]]]:
    """Pairs that are among the best of one of their frames."""
    taken: dict[int, int] = {}
    best = []
    for pair in sorted(raw, key=lambda pair: -len(pair[2])):
        first, second, features = pair
        used = min(taken.get(first, 0), taken.get(second, 0))
        if len(features) >= MIN_MATCHES and used < BEST_PAIRS_OF_A_FRAME:
            best.append(pair)
            taken[first] = taken.get(first, 0) + 1
            taken[second] = taken.get(second, 0) + 1
    return sorted(best, key=lambda pair: pair[:2])


def _verify(
    features: list[NDArray[np.float64]], raw: list[tuple[int, int, NDArray[np.uint32]]], *, progress: bool
) -> list[PairMatches]:
    """Matches that fit one fundamental matrix, of pairs that keep enough of them."""
    options = pycolmap.RANSACOptions()
    options.max_error = VERIFY_MAX_ERROR_PX
    options.min_num_trials, options.max_num_trials = 100, 2000
    options.random_seed = 0

    def verified(pair: tuple[int, int, NDArray[np.uint32]]) -> PairMatches | None:
        first, second, rows = pair
        found = pycolmap.estimate_fundamental_matrix(features[first][rows[:, 0]], features[second][rows[:, 1]], options)
        if found is None or found["num_inliers"] < MIN_MATCHES:
            return None
        return PairMatches(first, second, rows[np.asarray(found["inlier_mask"], dtype=bool)])

    pairs = []
    with ThreadPoolExecutor(_THREADS) as pool, _bar(len(raw), "verifying", "pair", progress=progress) as bar:
        for pair in pool.map(verified, raw):
            bar.update()
            if pair is not None:
                pairs.append(pair)
    return pairs
