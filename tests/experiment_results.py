"""A `results.json` of an experiment that never ran, with known figures: what the report is tested with."""

import base64
import json
import zlib

import numpy as np
from PIL import Image
from scipy import stats

METHODS = {
    "heuristic": (80, 0.2, 13.0),
    "random": (80, 0.25, 13.5),
    "frontier": (80, 0.92, 20.0),
    "greedy": (80, 0.96, 21.0),
    "oracle": (80, 0.99, 22.0),
    "coverage": (80, 0.95, 20.5),
    "coverage_redundancy": (80, 0.94, 20.4),
    "proposed": (56, 0.91, 20.6),
    "surface": (60, 0.88, 21.6),
    "proposed_rooms": (58, 0.88, 20.0),
    "surface_rooms": (62, 0.87, 21.0),
}
"""Views, final coverage and PSNR in the scene of training, before what is drawn at random for seed and start."""
LEARNED = ("coverage", "coverage_redundancy", "proposed", "surface", "proposed_rooms", "surface_rooms")
SCENES = ({"name": "white.glb", "sha256": "a", "role": "train"}, {"name": "grey.glb", "sha256": "b", "role": "unseen"})
FEW = ("heuristic", "coverage", "proposed", "surface")
TRAIN_ONLY = SCENES[:1]
HELDOUT = 6


def make_results(methods=tuple(METHODS), *, seeds=3, starts=2, prefixes=(20, 40, 60), scenes=SCENES, lpips=True):
    """The content of a `results.json`; the same for the same arguments."""
    rng = np.random.default_rng(0)
    episodes = [
        _episode(rng, method, scene, seed, start)
        for seed in range(seeds)
        for method in methods
        for scene in scenes
        for start in range(starts)
    ]
    return {
        "format": 1,
        "configuration": {
            "preset": "cpu",
            "seeds": seeds,
            "starts": starts,
            "budget": 80,
            "observation": "map",
            "steps": 700_000,
            "prefixes": list(prefixes),
            "scenes": list(scenes),
        },
        "methods": list(methods),
        "origin": {
            "command": "mlflow run . -e compare",
            "commits": ["0123456789abcdef"],
            "machine": {"platform": "Linux", "processor": "a processor", "cores": 2, "gpu": None},
            "versions": {"torch": "2.9"},
            "finished": "2026-11-22T18:00:00+00:00",
            "hours": 1.4,
        },
        "training": [_training(rng, method, seed) for seed in range(seeds) for method in methods if method in LEARNED],
        "rollouts": episodes,
        "reconstructions": [
            one for episode in episodes for one in _reconstructions(rng, episode, prefixes, lpips=lpips)
        ],
        "failed": [],
    }


def write_results(folder, results, *, pictures=True):
    """Write `results.json`, and small pictures of two held-out views, to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(results), encoding="utf-8")
    rng = np.random.default_rng(1)
    names = [scene["name"].removesuffix(".glb") for scene in results["configuration"]["scenes"]] if pictures else []
    for scene in names:
        (folder / "pictures").mkdir(exist_ok=True)
        for method in ("truth", *results["methods"]):
            for view in (3, 5):
                noise = Image.fromarray(rng.integers(0, 255, (12, 16, 3), dtype=np.uint8))
                noise.resize((192, 144), Image.Resampling.BICUBIC).save(
                    folder / f"pictures/{scene}-{method}-{view:02d}.png"
                )
    return folder


def _episode(rng, method, scene, seed, start):
    views, coverage, _ = METHODS[method]
    views = min(80, round(views + rng.normal(0, 3))) if views < 80 else 80
    coverage = float(np.clip(coverage + rng.normal(0, 0.02), 0.05, 1))
    curve = coverage * (1 - np.exp(-np.arange(1, views + 1) / 18)) / (1 - np.exp(-views / 18))
    return {
        "method": method,
        "scene": scene["name"],
        "role": scene["role"],
        "seed": seed,
        "start": start,
        "commit": "0123456789abcdef",
        "seconds": 5.0,
        "metrics": {
            "coverage": coverage,
            "views": float(views),
            "annd_m": float(0.05 + rng.normal(0, 0.005)),
            "ei": coverage / views,
            "path_length_m": float(5 + rng.normal(0, 0.3)),
            "collisions": 0,
            "visibility": 0.8 * coverage,
            **_geometry(coverage),
        },
        "coverage_curve": [float(share) for share in curve],
        "visibility_curve": [float(0.8 * share) for share in curve],
        "parallax_curve": [float(0.5 * share) for share in curve],
        "geometry_after": {str(k): _geometry(float(curve[k - 1])) for k in (20, 40, 60) if k < views},
        "map": _map(rng, views) if seed == start == 0 else None,
    }


def _geometry(coverage):
    lengths = {"accuracy_m": 0.001, "completion_m": 1 - coverage, "chamfer_m": (1.001 - coverage) / 2}
    shares = {"precision": 0.99, "completion_ratio": 0.9 * coverage, "f_score": 0.8 * coverage}
    return {**lengths, **shares, "depth_l1_m": 0.3}


def _reconstructions(rng, episode, prefixes, *, lpips):
    views = round(episode["metrics"]["views"])
    best = METHODS[episode["method"]][2] - (1.5 if episode["role"] == "unseen" else 0)
    wanted = [*(k for k in prefixes if k < views and episode["start"] == 0), None]
    for frames in wanted:
        used = frames or views
        psnr = best - 4 * np.exp(-used / 25) + rng.normal(0, 0.15)
        yield {
            **{name: episode[name] for name in ("method", "scene", "role", "seed", "start", "commit")},
            "frames": used,
            "views": views,
            "whole": frames is None,
            "seconds": 20.0,
            "iterations": 400,
            "scores": {"psnr": float(psnr), "ssim": 0.8, "lpips": 0.2 if lpips else None},
            "lpips_reason": None if lpips else "its weights are not there",
            "geometry": _geometry(0.7 * episode["coverage_curve"][used - 1]),
            "visibility": episode["visibility_curve"][used - 1],
            "per_view": [{"psnr": float(psnr + shift), "ssim": 0.8, "visibility": 0.5} for shift in range(HELDOUT)],
        }


def _training(rng, method, seed):
    steps = np.arange(8192, 700_000, 8192)
    rise = 1 - np.exp(-steps / 150_000)
    noise = rng.normal(0, 0.02, (2, len(steps)))
    top = 1.2 if method.startswith("coverage") else 1.5
    curves = {"avp/cpv": top * rise + noise[0], "rollout/ep_rew_mean": len(method) * rise + noise[1]}
    points = {name: [[int(k), float(v)] for k, v in zip(steps, values, strict=True)] for name, values in curves.items()}
    return {"method": method, "seed": seed, "steps": 700_000, "seconds": 100.0, "commit": "0123", "curves": points}


def _map(rng, views):
    rows, columns = 31, 47
    numbers = np.zeros((rows, columns), dtype="<u2")
    numbers[2:-2, 2:-2] = 1
    angle = np.cumsum(rng.normal(0, 0.25, views))
    path = np.clip(
        np.cumsum(0.12 * np.stack([-np.sin(angle), -np.cos(angle)], axis=1), axis=0), [-1.9, -1.2], [1.9, 1.2]
    )
    z, x = np.mgrid[0:rows, 0:columns] * 0.1 + np.array([-1.55, -2.35])[:, None, None] + 0.05
    for view, place in enumerate(path, start=1):
        near = (np.hypot(x - place[0], z - place[1]) < 0.5) & (numbers == 1)
        numbers[near] = 1 + view
    return {
        "cell_m": 0.1,
        "origin_m": [-2.35, -1.55],
        "shape": [rows, columns],
        "floor": base64.b64encode(zlib.compress(numbers.tobytes())).decode("ascii"),
        "path": [[float(px), float(pz), float(turn)] for (px, pz), turn in zip(path, angle, strict=True)],
    }


def by_seed(parts, value, **wanted):
    """Means of a figure by seed, computed without the report's code."""
    found = {}
    for part in parts:
        if all(part[name] == wish for name, wish in wanted.items()):
            found.setdefault(part["seed"], []).append(value(part))
    return [sum(values) / len(values) for values in found.values()]


def interval(values):
    """Mean and half width of the 95 % interval, as SciPy computes it."""
    mean = float(np.mean(values))
    low, high = stats.t.interval(0.95, len(values) - 1, loc=mean, scale=stats.sem(values))
    return mean, (high - low) / 2
