"""Which of torch's devices this computer has."""

from policy.errors import PolicyError

CPU = "cpu"


def require_devices(*wanted: str) -> None:
    """Refuse a device that is not here; torch is imported only to look for another than the CPU."""
    others = sorted({*wanted} - {CPU})
    if not others:
        return
    import torch

    available = [CPU, *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if torch.backends.mps.is_available():
        available.append("mps")
    for device in others:
        if (device if device != "cuda" else "cuda:0") not in available:
            built = ""
            if device.startswith("cuda") and torch.version.cuda is None:
                built = f" (torch {torch.__version__} is built without CUDA)"
            raise PolicyError(
                f"--device {device} is not available: this computer has {', '.join(available)}"
                f"{built}"
            )
