"""Comparisons and studies for developers; run one with ``python -m benchmarks.NAME``.

compare         our engines, flights and link beside a roofline, a baseline runner and other clients
rollout         imagined flights, serial and streamed
links           our client of the link and the others, turn by turn
stick_rates     exactness of the sticks, with an idle and a busy flight process
study           what makes a checkpoint fly well, one setting at a time
"""
