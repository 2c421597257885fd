"""ACT and DiffusionPolicy as LeRobot 0.4 to 0.6 saves them, without LeRobot.

``config`` reads config.json, ``statistics`` the normalisation, ``plan`` puts both together with the
contract file: all that is known without the weights and without torch. ``act`` and ``diffusion``
are the networks, ``policy`` makes them one function from the contract's inputs to its actions, and
``load`` reads the weights.
"""
