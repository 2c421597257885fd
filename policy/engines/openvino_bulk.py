"""Many images through an encoder, as fast as the CPU can: for training, not for flight."""

import numpy as np
import openvino as ov

from policy.contract import FloatArray
from policy.engines.executable import Precision
from policy.engines.openvino_compile import DEVICE
from policy.engines.openvino_graph import convert
from policy.engines.signal_stack import signal_stack_kept
from policy.nets.resnet_unet import ResnetUnet
from policy.nets.toge import Toge


class BulkEncoder:
    """The backbone of a policy, with its weights as they are now; one image a stream and core.

    Measured on two cores without matrix units, EfficientNet-B3 at 128x128: four times as many
    images a second as torch in batches.
    """

    def __init__(self, policy: Toge | ResnetUnet, precision: Precision) -> None:
        properties = {
            "PERFORMANCE_HINT": "THROUGHPUT",
            "INFERENCE_PRECISION_HINT": precision,
        }
        image = (1, 3, policy.contract.image_height, policy.contract.image_width)
        graph = convert(policy.backbone, policy.backbone, [image])
        with signal_stack_kept():
            compiled = ov.Core().compile_model(graph, DEVICE, properties)
            self._queue = ov.AsyncInferQueue(compiled, 0)
        self._dim = policy.backbone.out_dim

    def __call__(self, images: FloatArray) -> FloatArray:
        """Normalised images [B, 3, H, W] of the contract's size -> outputs [B, D]."""
        out = np.empty((len(images), self._dim), np.float32)

        def keep(request: "ov.InferRequest", row: int) -> None:
            out[row] = request.get_output_tensor(0).data[0]

        self._queue.set_callback(keep)
        for row in range(len(images)):
            image = np.ascontiguousarray(images[row : row + 1])
            self._queue.start_async({0: image}, row)
        self._queue.wait_all()
        return out
