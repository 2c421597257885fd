from benchmarks.engines import CHUNK, ENCODE, time_engines
from mavbridge.config.policy import PolicyConfig

TINY = "toge:small:resnet8"


def test_every_piece_of_work_is_timed_on_the_chosen_engine() -> None:
    policy = PolicyConfig(
        policy=TINY, allow_untrained=True, image_size=32, dual_rate=True, engine="torch"
    )
    timings = time_engines((policy,), rounds=1, block_s=0.01)
    works = [(one.engine, one.work) for one in timings]
    assert works == [("torch", ENCODE), ("torch", CHUNK)]
    assert all(0 < one.p50_ms <= one.p99_ms for one in timings)
