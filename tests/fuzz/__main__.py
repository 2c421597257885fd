"""``python -m fuzz``: many hostile datagrams, on all cores; `make fuzz` runs it.

Eight of ten go to the codec alone, one to a link with a key, one through whole flights. A failure
prints the datagrams.
"""

import argparse
import os
import secrets
import sys
from concurrent.futures import Future, ProcessPoolExecutor, as_completed

from fuzz.codec_target import FuzzError, fuzz_codec
from fuzz.link_target import COMBINATIONS, HostileFlight
from fuzz.signed_target import fuzz_signing
from mavbridge.core.clock import NS_PER_S, MonotonicClock

CODEC_CHUNK, FLIGHT_CHUNK = 50_000, 50_000
FLIGHT_SHARE = SIGNED_SHARE = 0.1


def fuzz_flight(seed: int, count: int) -> None:
    """Feed datagrams to flights of one firmware with one kind of action."""
    autopilot, kind = COMBINATIONS[seed % len(COMBINATIONS)]
    HostileFlight(seed, autopilot, kind, share=2000).run(count)


def _run(datagrams: int, seed: int, workers: int) -> int:
    clock, fed, failures = MonotonicClock(), 0, 0
    start_ns = clock.now_ns()
    in_flights, signed = round(datagrams * FLIGHT_SHARE), round(datagrams * SIGNED_SHARE)
    with ProcessPoolExecutor(workers) as pool:
        work: dict[Future[None], tuple[str, int, int]] = {}
        for target, total, chunk in (
            (fuzz_flight, in_flights, FLIGHT_CHUNK),
            (fuzz_signing, signed, CODEC_CHUNK),
            (fuzz_codec, datagrams - in_flights - signed, CODEC_CHUNK),
        ):
            for number, at in enumerate(range(0, total, chunk)):
                count = min(chunk, total - at)
                future = pool.submit(target, seed + number, count)
                work[future] = (target.__name__, seed + number, count)
        for future in as_completed(work):
            name, number, count = work[future]
            try:
                future.result()
            except FuzzError as failure:
                failures += 1
                print(f"FAILED: {name}({number}, {count}): {failure}", flush=True)
            fed += count
            elapsed_s = (clock.now_ns() - start_ns) / NS_PER_S
            print(f"{fed:,} of {datagrams:,} datagrams, {failures} failures, {elapsed_s:.0f} s")
            sys.stdout.flush()
    return 1 if failures else 0


def main() -> int:
    """Exit status 0: no failure."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--datagrams", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=None, help="by default another one each time")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    seed = secrets.randbelow(10**9) if given.seed is None else given.seed
    print(f"seed {seed}: FUZZ_SEED={seed} make fuzz feeds the same datagrams again", flush=True)
    return _run(given.datagrams, seed, given.workers)


if __name__ == "__main__":
    sys.exit(main())
