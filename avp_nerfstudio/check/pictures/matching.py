"""Features of a rollout's pictures and their matches, found without looking at its poses or its focal length."""

import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
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

    def pixels(self, pair: PairMatches) -> NDArray[np.float64]:
        """`(2, m, 2)` where the matches of a pair lie in its first and in its second picture."""
        first, second = pair.features.T
        return np.array([self.features[pair.first][first], self.features[pair.second][second]])


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's own log lines, but for errors, from the terminal."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 2
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def ransac_options(max_error_px: float, *, most: int) -> pycolmap.RANSACOptions:
    """Options that find the same every time, in at most so many trials."""
    options = pycolmap.RANSACOptions()
    options.max_error = max_error_px
    options.min_num_trials, options.max_num_trials = 100, most
    options.random_seed = 0
    return options


def match_pictures(rollout: Rollout, *, progress: bool = True) -> Matches:
    """SIFT on the frames of a rollout, matched pair by pair and verified by uncalibrated epipolar geometry.

    Args:
        rollout: of at most `MAX_FRAMES` frames, or else runs of its frames are taken.
        progress: show bars.

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
    with quiet_colmap(), tempfile.TemporaryDirectory(prefix="pictures-") as scratch:
        database = Path(scratch) / "database.db"
        features = _extract(database, folder, names, progress=progress)
        raw = _match(database, names, _candidates(len(names)), progress=progress)
    best = sorted(best_pairs(raw, BEST_PAIRS_OF_A_FRAME, least=MIN_MATCHES), key=lambda pair: (pair.first, pair.second))
    matches = Matches(folder, names, frames, features, best)
    return replace(matches, pairs=_verify(matches, progress=progress))


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
    features = []
    with pycolmap.Database.open(database) as opened:
        for name in names:
            image = opened.read_image_with_name(name)
            if image is None:
                raise RolloutError(f"{folder / name}: expected an 8-bit RGB PNG, COLMAP could not read its pixels")
            features.append(opened.read_keypoints(image.image_id)[:, :2].astype(np.float64))
    return features


def _match(database: Path, names: list[str], pairs: list[tuple[int, int]], *, progress: bool) -> list[PairMatches]:
    """Nearest descriptors of every pair, not verified."""
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
    place = {name: index for index, name in enumerate(names)}
    found = []
    with pycolmap.Database.open(database) as opened:
        where = {image.image_id: place[image.name] for image in opened.read_all_images()}
        for pair_id, features in zip(*opened.read_all_matches(), strict=True):
            first, second = (where[image] for image in pycolmap.pair_id_to_image_pair(pair_id))
            ordered = (first, second, features) if first < second else (second, first, features[:, ::-1])
            found.append(PairMatches(*ordered))
    return found


def best_pairs(pairs: list[PairMatches], of_a_frame: int, *, least: int) -> list[PairMatches]:
    """Pairs with enough matches that are among the best of one of their frames, the richest first."""
    taken: Counter[int] = Counter()
    best = []
    for pair in sorted(pairs, key=lambda pair: -len(pair.features)):
        if len(pair.features) >= least and min(taken[pair.first], taken[pair.second]) < of_a_frame:
            best.append(pair)
            taken.update((pair.first, pair.second))
    return best


def _verify(unverified: Matches, *, progress: bool) -> list[PairMatches]:
    """Matches that fit one fundamental matrix, of pairs that keep enough of them."""
    options = ransac_options(VERIFY_MAX_ERROR_PX, most=2000)

    def verified(pair: PairMatches) -> PairMatches | None:
        first, second = unverified.pixels(pair)
        found = pycolmap.estimate_fundamental_matrix(first, second, options)
        if found is None or found["num_inliers"] < MIN_MATCHES:
            return None
        return replace(pair, features=pair.features[np.asarray(found["inlier_mask"], dtype=bool)])

    with ThreadPoolExecutor(_THREADS) as pool:
        done = pool.map(verified, unverified.pairs)
        bar = command.progress(done, total=len(unverified.pairs), desc="verifying", unit="pair", disable=not progress)
        return [pair for pair in bar if pair is not None]
