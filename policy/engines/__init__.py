"""How a policy is executed: each module makes a ``contract.Executable`` of one engine."""
