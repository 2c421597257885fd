"""Engines that execute a policy; each creates a ``protocol.PolicyRunner``."""

import sys

# On import, openvino reports to its vendor's analytics server and writes an id to the home folder,
# unless its telemetry package cannot be imported. A flight computer must not report to anyone.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
