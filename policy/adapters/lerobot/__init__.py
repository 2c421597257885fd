"""ACT and DiffusionPolicy as LeRobot 0.4 to 0.6 saves them, without LeRobot.

``plan`` puts together all that is known without the weights and without torch: config.json, the
normalisation and the contract file. ``policy`` loads the weights into ``act`` or ``diffusion``.
"""
