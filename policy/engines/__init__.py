"""Engines that execute a policy; each makes a ``protocol.PolicyRunner``."""

import sys

# On import openvino reports to its vendor's analytics server and writes an id into the home folder,
# unless its telemetry package cannot be imported. A flight computer reports to nobody.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
