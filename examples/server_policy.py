"""A policy on a server: climbs to 2.8 m above home and turns. Needs no mavbridge where it runs.

pip install websockets msgpack numpy && python examples/server_policy.py
make fly POLICY=ws://127.0.0.1:8000 DURATION=20
"""

import sys

import msgpack
import numpy as np
from websockets.sync.server import serve

CONTRACT = '{"state_extras": ["height"], "image_height": 96, "image_width": 96, "horizon": 16}'


def answer(connection):
    connection.send(msgpack.packb({"mavbridge_contract": CONTRACT}))
    for request in connection:
        state = np.frombuffer(msgpack.unpackb(request)["observation.state"][b"data"], np.float32)
        throttle = float(np.clip(3.0 - state[-1], -0.5, 0.5))  # the height is the last number
        connection.send(msgpack.packb({"actions": [[throttle, 0.2, 0.0, 0.0]] * 16}))


if __name__ == "__main__":
    port = int(sys.argv[1]) if len(sys.argv) > 1 else 8000
    with serve(answer, "127.0.0.1", port, compression=None) as server:
        server.serve_forever()
