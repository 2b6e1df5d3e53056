"""Your own fusion: reads reports (JSON lines, as for `ecod-node replay`) and writes a map for each 100 ms."""

import itertools
import json
import sys
import uuid

reports = sorted(map(json.loads, sys.stdin), key=lambda report: report["captured_at_us"])
periods = itertools.groupby(reports, lambda report: report["captured_at_us"] // 100_000)
for number, (period, group) in enumerate(periods, start=1):
    known = [{"covariance_m2": [1, 0, 1], "contributors": [report["node"]], **each}
             for report in group for each in report["objects"]]
    # Your method goes here. This one has the most confident report of each location, and every other object as it is.
    best = {each["landmark"]: each for each in sorted(known, key=lambda each: each["confidence"]) if "landmark" in each}
    objects = [{"id": str(uuid.uuid4()), **each} for each in known if "landmark" not in each]
    landmarks = [{"id": place, **{key: each[key] for key in ("label", "confidence", "x_m", "y_m", "contributors")}}
                 for place, each in best.items()]
    print(json.dumps({"schema": 1, "aggregator": "own", "epoch": 1, "round": number,
                      "fused_at_us": (period + 1) * 100_000, "landmarks": landmarks, "objects": objects}))
