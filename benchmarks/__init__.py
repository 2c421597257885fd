"""Comparisons and studies for developers; run one with ``python -m benchmarks.NAME``.

compare             our engines, a flight, and our link beside others
link                latency of our link client and of others, in turn
two_rates           one rate and two rates, over the time to encode an image
train_shipped       training of the shipped policies
"""
