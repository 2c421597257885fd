"""Comparisons and studies for developers; run one with ``python -m benchmarks.NAME``.

compare, link, two_rates, engines   our rates, latencies and engines, beside others
train_shipped, teach_looks          training of the shipped policies
animation, page_pictures, ...       pictures and generated pages of the documentation
"""
