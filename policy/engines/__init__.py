"""How a policy is executed: each module makes a ``contract.Executable`` of one engine."""

import sys

# On import openvino reports to its makers' analytics server and writes an id into the home folder,
# unless this package of theirs cannot be imported. A flight computer calls nobody.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
