"""LeRobot's ACT, SmolVLA or pi0 on a server, in LeRobot's own environment.

pip install lerobot websockets msgpack          # LeRobot 0.4 or newer
python lerobot_server.py run/checkpoints/last/pretrained_model --host 0.0.0.0
mavbridge --connect /dev/ttyACM0,921600 --camera 0 --policy ws://gpu:8000 --contract contract.toml

With --rtc DT, the contract's chunk_dt_s, and prefix_len in the contract, policies that take it
(SmolVLA, pi0) continue their last chunk by LeRobot's real-time chunking.
"""

import argparse
import json
import time

import msgpack
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from websockets.sync.server import serve


class Server:
    def __init__(self, folder: str, rtc_dt_s: float | None) -> None:
        config = PreTrainedConfig.from_pretrained(folder)
        if rtc_dt_s is not None:
            from lerobot.policies.rtc.configuration_rtc import RTCConfig

            config.rtc_config = RTCConfig(enabled=True)
        self.policy = get_policy_class(config.type).from_pretrained(folder, config=config).eval()
        self.before, self.after = make_pre_post_processors(config, folder)
        self.device, self.rtc_dt_s = torch.device(config.device), rtc_dt_s
        self.left_over, self.asked_s = None, 0.0
        _, height, width = next(iter(config.image_features.values())).shape
        fields = {"horizon": config.chunk_size, "image_height": height, "image_width": width}
        self.fields = json.dumps(fields)  # the client's contract file has the rest

    def answer(self, connection) -> None:
        self.policy.reset()
        self.left_over = None
        connection.send(msgpack.packb({"mavbridge_fields": self.fields}))
        for request in connection:
            try:
                actions = self.actions(msgpack.unpackb(request, object_hook=to_array))
                connection.send(msgpack.packb({"actions": actions.tolist()}))
            except Exception as error:  # noqa: BLE001 - the client reports a text
                connection.send(f"{type(error).__name__}: {error}")

    @torch.no_grad()
    def actions(self, message: dict) -> torch.Tensor:
        arrays = {key: value for key, value in message.items() if isinstance(value, np.ndarray)}
        arrays.pop("prefix", None)  # LeRobot wants its own last chunk, normalised
        prompt = message.get("prompt", "")
        batch = self.before(prepare_observation_for_inference(arrays, self.device, prompt))
        asked_s, options = time.monotonic(), {}  # noqa: TID251 - knows no mavbridge
        if self.rtc_dt_s is not None and self.left_over is not None:
            flown = round((asked_s - self.asked_s) / self.rtc_dt_s)
            delay = round(message.get("delay_s", 0.0) / self.rtc_dt_s)
            options = {
                "prev_chunk_left_over": self.left_over[flown:],
                "inference_delay": delay,
            }
        chunk = self.policy.predict_action_chunk(batch, **options)
        self.left_over, self.asked_s = chunk[0], asked_s
        return self.after(chunk)[0]


def to_array(found: dict) -> object:
    if b"__ndarray__" not in found:
        return found
    return np.frombuffer(found[b"data"], found[b"dtype"]).reshape(found[b"shape"]).copy()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--rtc", type=float, metavar="DT")
    flags = parser.parse_args()
    answer = Server(flags.folder, flags.rtc).answer
    images = {"compression": None, "max_size": None}  # two of 640x480 exceed the usual 1 MiB
    with serve(answer, flags.host, flags.port, **images) as listening:
        listening.serve_forever()
