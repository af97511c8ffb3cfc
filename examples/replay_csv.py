"""Replays measurements from a CSV file at its own pace, as the sensors of a building would send them (docs/sensors.md).

python examples/replay_csv.py [FILE] [ENDPOINT] [SECONDS PER ROW]

A row is one sample. Column 1.y.room5 is a measurement of node 1, column 1.u.hvac2 an input that node 1 is told.
"""

import csv
import json
import sys
import time
from pathlib import Path

import zenoh

given = dict(enumerate(sys.argv))
file, endpoint = given.get(1, Path(__file__).with_name("rooms.csv")), given.get(2, "tcp/127.0.0.1:7447")
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
config.insert_json5("connect/timeout_ms", "-1")  # wait for the gateway
with zenoh.open(config) as session, open(file, newline="") as rows:
    table = csv.DictReader(rows)
    nodes = sorted({name.split(".")[0] for name in table.fieldnames})
    block = zenoh.CongestionControl.BLOCK  # the default drops a message where there is no room for it
    sensors = {i: session.declare_publisher(f"building/{i}/y", congestion_control=block) for i in nodes}
    while not all(sensor.matching_status.matching for sensor in sensors.values()):
        time.sleep(0.1)  # nobody would hear us
    for k, row in enumerate(table):
        for i, sensor in sensors.items():
            y, u = ([float(row[name]) for name in row if name.startswith(f"{i}.{kind}.")] for kind in "yu")
            sensor.put(json.dumps({"k": k, "y": y, "u": u}))
        time.sleep(float(given.get(3, 0.1)))
    session.put("building/end", "", congestion_control=block)
