"""ACT and DiffusionPolicy as saved by LeRobot 0.4 to 0.6, without LeRobot installed.

``plan`` reads config.json, the normalisation and the contract file, without weights or torch.
``policy`` loads the weights into ``act`` or ``diffusion``, both of them a ``base.LeRobotPolicy``.
"""
