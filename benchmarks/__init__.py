"""Comparisons and studies for developers; run one with ``python -m benchmarks.NAME``.

compare         our engines, flights and link beside a roofline, a baseline runner and other clients
rollout         imagined flights, serial and streamed
study           what makes a checkpoint fly well, one setting at a time
"""
