"""Comparisons and studies for developers; run one with ``python -m benchmarks.NAME``.

compare             our engines, flights and link beside a roofline, a baseline runner and others
link                our client of the link and the others, turn by turn
lerobot_policies    LeRobot's policies on our engines, beside its own code
two_rates           one loop and two, by the time that an image takes to encode
train_shipped       training of what ships
"""
