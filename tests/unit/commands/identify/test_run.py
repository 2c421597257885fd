import pytest

from faults.stage import faulty_policy
from helpers.fakes import FakeClock
from mavbridge.commands.config import IdentifyConfig
from mavbridge.commands.identify.run import doublet_flight, doublet_policy
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import UserError
from mavbridge.flight.policies import configured_contract
from policy.contract import Contract
from policy.scripted.programs import doublet_length_s


def test_the_flight_is_the_users_with_the_doublet_in_place_of_the_policy() -> None:
    link = LinkConfig(connect="udp:127.0.0.1:1")
    asked = FlyConfig(link=link, arm=True, takeoff=10.0, policy=PolicyConfig(policy="toge"))
    flight = doublet_flight(IdentifyConfig(flight=asked), Contract(action="velocity"))
    assert flight.policy.policy == "scripted:doublet:velocity"
    assert flight.camera.sources == ("none",)
    assert flight.link.raw_sticks
    assert flight.takeoff == 10.0
    assert flight.duration is not None
    assert flight.duration > doublet_length_s("velocity") + 8.0
    mapped = doublet_flight(IdentifyConfig(flight=asked, mapped_sticks=True), Contract())
    assert not mapped.link.raw_sticks


def test_a_flight_that_sends_nothing_is_refused() -> None:
    asked = FlyConfig(link=LinkConfig(connect="udp:127.0.0.1:1", readonly=True))
    with pytest.raises(UserError, match="readonly"):
        doublet_flight(IdentifyConfig(flight=asked), Contract())


def test_the_doublet_means_by_its_sticks_what_the_policy_means() -> None:
    trained = Contract(full_lean_deg=20.0, yaw_dead_zone=0.1, image_height=96, image_width=96)
    policy, executable = doublet_policy(trained, FakeClock(), is_in_air=True)
    assert executable.contract.full_lean_deg == 20.0
    assert executable.contract.yaw_dead_zone == 0.1
    assert executable.dual_rate
    assert policy.program_start_s is None


def test_the_contract_is_that_of_the_policy_of_the_flags() -> None:
    assert configured_contract(PolicyConfig()).action == "sticks"
    rates = configured_contract(PolicyConfig(policy="scripted:square:rates"))
    assert rates.action == "rates"
    own = configured_contract(PolicyConfig(policy=faulty_policy("SingleRate")))
    assert own.action == "sticks"
