import subprocess
import sys

import pytest

SCRIPT = """
import ctypes, gc, os, signal
from policy.loading.request import PolicyRequest
from policy.loading.load import load_policy

request = PolicyRequest(
    spec="toge:small:resnet8", allow_untrained=True, engine="openvino", num_diffusion_steps=1,
    image_size=32,
)
loaded = load_policy(request, now_s=lambda: 0.0)
heard = []
signal.signal(signal.SIGINT, lambda *_: heard.append("in flight"))
os.kill(os.getpid(), signal.SIGINT)
del loaded
gc.collect()
signal.signal(signal.SIGINT, lambda *_: heard.append("after it"))
os.kill(os.getpid(), signal.SIGINT)
print(heard)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the alternate signal stack is kept on Linux")
def test_a_signal_is_heard_whatever_has_become_of_the_engine() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == "['in flight', 'after it']"
