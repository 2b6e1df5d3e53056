#!/usr/bin/env python3
"""Compares `ecod-lab eval` of tracks with published implementations.

    check-eval-tracks.py TRUTH MAPS RESULT [--write EXPECTED]

TRUTH and MAPS are the input of `ecod-lab eval`, RESULT what it wrote with --out. HOTA, CLEAR MOT and identity are
computed by TrackEval, switches, distances and IDF1 again by motmetrics, average precision by the function of PASCAL VOC as
OPV2V's program has it. EXPECTED receives the figures of these programs.
"""
import json
import math
import sys
from collections import defaultdict

import motmetrics
import numpy as np
from scipy.optimize import linear_sum_assignment
from trackeval.metrics import CLEAR, HOTA, Identity

MATCH_M, ZERO_M, REACH = 2.0, 4.0, 0.75
CONFIDENCE_M = 1.5
DISTANCES_M = [0.5, 1.0, 2.0, 4.0]
TOLERANCE = 1e-6


def read(truth_path, maps_path):
    """Frames of (true objects, published objects): the nearest map, and the truth at its time."""
    truth = json.load(open(truth_path))["frames"]
    maps = [json.loads(line) for line in open(maps_path) if line.strip()]
    times = np.array([m["fused_at_us"] for m in maps], dtype=np.int64)
    steps = sorted(b["t_us"] - a["t_us"] for a, b in zip(truth, truth[1:]))
    reach = int(REACH * steps[len(steps) // 2])
    frames = []
    for number, frame in enumerate(truth):
        away = np.abs(times - frame["t_us"])
        nearest = len(away) - 1 - int(np.argmin(away[::-1]))
        here = {o["id"]: (o["label"], o["x_m"], o["y_m"]) for o in frame["objects"]}
        if away[nearest] > reach:
            frames.append((here, []))
            continue
        ahead = int(times[nearest]) - frame["t_us"]
        other = number + (1 if ahead > 0 else -1)
        if ahead != 0 and 0 <= other < len(truth):
            share = ahead / (truth[other]["t_us"] - frame["t_us"])
            there = {o["id"]: (o["x_m"], o["y_m"]) for o in truth[other]["objects"]}
            for key, (label, x, y) in here.items():
                if key in there:
                    here[key] = (label, x + (there[key][0] - x) * share, y + (there[key][1] - y) * share)
        said = [(o["id"], o["label"], o["confidence"], o["x_m"], o["y_m"]) for o in maps[nearest]["objects"]]
        frames.append((here, said))
    return frames


def distance(true, said):
    return math.hypot(true[1] - said[3], true[2] - said[4]) if true[0] == said[1] else math.inf


def greedy(frames, limit):
    """Score and hit of every published object, by label."""
    hits = defaultdict(list)
    for here, said in frames:
        taken = set()
        for object_ in sorted(said, key=lambda s: -s[2]):
            near = [(distance(true, object_), key) for key, true in here.items() if key not in taken]
            near = [pair for pair in near if pair[0] <= limit]
            if near:
                taken.add(min(near)[1])
            hits[object_[1]].append((object_[2], bool(near)))
    return hits


def curve(hits, objects):
    """Thresholds, recalls and precisions; equal scores enter together."""
    hits = sorted(hits, key=lambda hit: -hit[0])
    right = np.cumsum([hit for _, hit in hits])
    last = [n for n in range(len(hits)) if n + 1 == len(hits) or hits[n + 1][0] != hits[n][0]]
    return [hits[n][0] for n in last], [right[n] / objects for n in last], [right[n] / (n + 1) for n in last]


def voc_ap(rec, prec):
    """Of OpenCOOD, opencood/utils/eval_utils.py, after PASCAL VOC 2010."""
    mrec, mpre = [0.0, *rec, 1.0], [0.0, *prec, 0.0]
    for i in range(len(mpre) - 2, -1, -1):
        mpre[i] = max(mpre[i], mpre[i + 1])
    return sum((mrec[i] - mrec[i - 1]) * mpre[i] for i in range(1, len(mrec)) if mrec[i] != mrec[i - 1])


def precision_figures(frames):
    objects = defaultdict(int)
    for here, _ in frames:
        for label, _, _ in here.values():
            objects[label] += 1
    aps = []
    for limit in DISTANCES_M:
        hits = greedy(frames, limit)
        of_class = [voc_ap(*curve(hits[label], count)[1:]) if hits[label] else 0.0 for label, count in objects.items()]
        aps.append(100 * sum(of_class) / len(of_class))
    every = [hit for hits in greedy(frames, MATCH_M).values() for hit in hits]
    points = zip(*curve(every, sum(objects.values())))
    f1, threshold = max((2 * p * r / (p + r) if p + r else 0.0, t) for t, r, p in points)
    return aps, 100 * f1, threshold


def trackeval_figures(frames):
    true_ids, said_ids = {}, {}
    data = {"gt_ids": [], "tracker_ids": [], "similarity_scores": []}
    for here, said in frames:
        data["gt_ids"].append(np.array([true_ids.setdefault(key, len(true_ids)) for key in here], dtype=int))
        data["tracker_ids"].append(np.array([said_ids.setdefault(s[0], len(said_ids)) for s in said], dtype=int))
        similar = [[max(0.0, 1 - distance(true, s) / ZERO_M) for s in said] for true in here.values()]
        data["similarity_scores"].append(np.array(similar, dtype=float).reshape(len(here), len(said)))
    data["num_timesteps"] = len(frames)
    data["num_gt_ids"], data["num_tracker_ids"] = len(true_ids), len(said_ids)
    data["num_gt_dets"] = sum(len(ids) for ids in data["gt_ids"])
    data["num_tracker_dets"] = sum(len(ids) for ids in data["tracker_ids"])
    quiet = {"PRINT_CONFIG": False, "THRESHOLD": 0.5}
    hota = HOTA().eval_sequence(data)
    clear = CLEAR(quiet).eval_sequence(data)
    identity = Identity(quiet).eval_sequence(data)
    return {
        "matches": int(clear["CLR_TP"]),
        "false_alarms": int(clear["CLR_FP"]),
        "misses": int(clear["CLR_FN"]),
        "id_switches": int(clear["IDSW"]),
        "fragments": int(clear["Frag"]),
        "moda_pct": 100 * clear["MODA"],
        "mota_pct": 100 * clear["MOTA"],
        "motp_m": ZERO_M * (1 - clear["MOTP"]),
        "modp_pct": 100 * (1 - ZERO_M * (1 - clear["MOTP"]) / MATCH_M),
        "idf1_pct": 100 * identity["IDF1"],
        "hota_pct": 100 * float(np.mean(hota["HOTA"])),
        "deta_pct": 100 * float(np.mean(hota["DetA"])),
        "assa_pct": 100 * float(np.mean(hota["AssA"])),
        "loca_pct": 100 * float(np.mean(hota["LocA"])),
    }


def calibration_error(frames):
    """Expected calibration error of the confidences in percent, matched by SciPy."""
    bins = [[0, 0, 0.0] for _ in range(10)]
    for here, said in frames:
        far = np.array([[distance(true, s) for s in said] for true in here.values()], dtype=float)
        worth = np.where(far <= CONFIDENCE_M, 2.0 - np.minimum(far, CONFIDENCE_M) / CONFIDENCE_M, 0.0).reshape(len(here), len(said))
        right = {column for row, column in zip(*linear_sum_assignment(-worth)) if worth[row, column] > 0}
        for column, object_ in enumerate(said):
            bin_ = bins[min(int(object_[2] * 10), 9)]
            bin_[0] += 1
            bin_[1] += column in right
            bin_[2] += object_[2]
    return 100 * sum(abs(right - stated) for _, right, stated in bins) / sum(count for count, _, _ in bins)


def motmetrics_figures(frames):
    """By distances instead of similarities; ties and contests may be settled otherwise than by TrackEval."""
    seen = motmetrics.MOTAccumulator(auto_id=True)
    true_ids, said_ids = {}, {}
    for here, said in frames:
        far = np.array([[distance(true, s) for s in said] for true in here.values()], dtype=float)
        far = far.reshape(len(here), len(said))
        far[far > MATCH_M] = np.nan
        seen.update(
            [true_ids.setdefault(key, len(true_ids)) for key in here],
            [said_ids.setdefault(s[0], len(said_ids)) for s in said],
            far,
        )
    names = ["num_switches", "mota", "motp", "idf1"]
    row = motmetrics.metrics.create().compute(seen, metrics=names).iloc[0]
    return {name: float(row[name]) for name in names}


def main():
    truth, maps, result = sys.argv[1:4]
    frames = read(truth, maps)
    ours = json.load(open(result))["tracks"]
    aps, f1, threshold = precision_figures(frames)
    wrong = []

    def check(what, found, expected, tolerance=TOLERANCE):
        is_right = abs(found - expected) <= tolerance
        print(f"{what:32} {found:14.6f} {expected:14.6f} {'' if is_right else 'DIFFERS'}")
        if not is_right:
            wrong.append(what)

    print(f"{'':32} {'ecod':>14} {'reference':>14}")
    for limit, found, expected in zip(DISTANCES_M, ours["ap_pct"], aps):
        check(f"AP@{limit}", found, expected)
    check("best F1", ours["best_f1_pct"], f1)
    error = calibration_error(frames)
    check("calibration error", ours["calibration"]["confidence"]["ece_pct"], error)
    expected = {"ap_pct": aps, "best_f1_pct": f1, "best_f1_threshold": threshold}
    expected["calibration"] = {"confidence": {"ece_pct": error}}
    for name, level in [("at_best_f1", threshold), ("at_default", 0.5)]:
        kept = [(here, [s for s in said if s[2] >= level]) for here, said in frames]
        check(f"{name} threshold", ours[name]["threshold"], level)
        expected[name] = trackeval_figures(kept)
        for figure, value in expected[name].items():
            check(f"{name} {figure}", ours[name][figure], value)
        other = motmetrics_figures(kept)
        # motmetrics matches as many as it can before it compares distances: one pair in a thousand may differ.
        check(f"{name} mota (motmetrics)", ours[name]["mota_pct"], 100 * other["mota"], 0.1)
        check(f"{name} motp (motmetrics)", ours[name]["motp_m"], other["motp"], 1e-3)
        check(f"{name} idf1 (motmetrics)", ours[name]["idf1_pct"], 100 * other["idf1"], 0.1)
        expected[name]["motmetrics"] = other
    if "--write" in sys.argv:
        with open(sys.argv[sys.argv.index("--write") + 1], "w") as file:
            json.dump(expected, file, indent=1)
            file.write("\n")
    sys.exit(f"these differ: {', '.join(wrong)}" if wrong else 0)


main()
