"""``mavbridge export-policy``: a policy of ours as ONNX or TorchScript."""
