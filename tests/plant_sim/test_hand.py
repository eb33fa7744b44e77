"""Manual override: its start, its end, and the check that the plant stays in X; no clock, no process."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lbmpc.plants import Known
from node_runtime.config.sections import Config
from plant_sim.shield import Shield
from plant_sim.simulator import Motion
from plant_sim.way_back import WayBack, way_back_of
from protocol import messages as m
from tests.plant_sim.commands import PERIOD, planned

CART = Known.from_matrices(
    [[0.0, 1.0], [0.0, 0.0]],
    [[0.0, 0.0], [1.0, 0.5]],
    name="cart",
    states=("place", "speed"),
    inputs=("pull", "push"),
    W=[0.01, 0.05],
    x_min=[-1.0, -1.0],
    x_max=[1.0, 1.0],
    u_min=[-1.0, -1.0],
    u_max=[1.0, 1.0],
)
"""It keeps moving by itself, and leaves X unless it is braked in time."""
WAY_BACK = way_back_of(Config(rate=1.0 / PERIOD), CART)


class Cart:
    """A cart behind the shield in virtual time; the controller commands `commanded`."""

    def __init__(self, x0: tuple[float, float] = (0.0, 0.0), way_back: object = WAY_BACK):
        self.shield = Shield(CART, PERIOD, 1.25, "plant-a", True, way_back)
        self.motion = Motion(_Exactly(), np.array(x0), PERIOD)
        self.k = -1
        self.commanded: list[float] | None = [0.0, 0.0]
        self.blind = False

    def next(self, periods: int = 1) -> m.PlantState:
        """Advance by some periods, each with its command; return the last sample."""
        for _ in range(periods):
            self.k += 1
            t = self.k * PERIOD
            self.shield.advance(t, self.motion)
            x = self.motion.read(t)
            state = self.shield.sample(t, x)
            self.shield.renew(t, None if self.blind else x, self.motion)
            if self.commanded is not None:
                self.shield.command(planned(self.k, [self.commanded] * 3, self.k), t)
        return state

    def say(self, run_id: str, seq: int, u: float | None = 0.4, lease: float = 1.0) -> str:
        """Send a message that arrives in the middle of the period; with u None it is `auto`."""
        both = [] if u is None else [u, 0.0]
        word = m.Override(run_id=run_id, seq=seq, mode="auto" if u is None else "manual", u=both, lease=lease)
        return self.shield.override(word, (self.k + 0.5) * PERIOD)


class _Exactly:
    """A motion that equals the model."""

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        push = CART.B[1] @ u
        return np.array([x[0] + dt * x[1] + 0.5 * dt**2 * push, x[1] + dt * push])


def _braking(x: np.ndarray) -> list[float]:
    """Brake to rest at the centre within the input's range, as a controller does."""
    wanted = float(np.clip(-2.0 * x[0] - 3.0 * x[1], -1.0, 1.0))
    return [wanted, wanted]


def _ended(plant: Known, way_back: WayBack, u: float) -> np.ndarray:
    """Return the state in which an override with `u` is refused, starting near an edge."""
    shield = Shield(plant, PERIOD, 1.25, "plant-a", True, way_back)
    motion = Motion(_Exactly(), np.array([-0.9, 0.0]), PERIOD, plant.dead_time, np.zeros(2))
    for k in range(200):
        t = k * PERIOD
        shield.advance(t, motion)
        x = motion.read(t)
        shield.sample(t, x)
        if shield.override(m.Override(run_id="a", seq=k, mode="manual", u=[u, 0.0]), t) == "ended":
            return x
        shield.renew(t, x, motion)
    raise AssertionError("the override never ended")


def test_it_acts_from_the_next_sample_and_is_followed_by_the_newest_command() -> None:
    cart = Cart()
    cart.next(3)
    assert cart.say("a", 0) == "ok"
    first, second = cart.next(), cart.next()
    assert (first.source, second.source, second.applied) == ("command", "manual", [0.4, 0.0])
    cart.commanded = [-0.2, 0.1]
    cart.next(2)
    assert cart.say("a", 1, None) == "ok"
    last = cart.next()
    # The command received meanwhile acts at once, and is reported as the last one.
    assert [piece.u for piece in last.pieces] == [[0.4, 0.0], [-0.2, 0.1]]
    after = cart.next()
    assert (last.source, after.source, after.applied) == ("command", "command", [-0.2, 0.1])
    assert (after.command_seq, cart.shield.hand.ended) == (cart.k - 1, "")


def test_inputs_beyond_the_actuator_are_clipped() -> None:
    cart = Cart()
    cart.next(2)
    cart.say("a", 0, 99.0)
    assert cart.next(2).applied == [1.0, 0.0]


def test_it_ends_exactly_with_its_lease_and_does_not_resume() -> None:
    cart = Cart()
    cart.next(2)
    cart.say("a", 0, lease=2.25 * PERIOD)
    for seq in (1, 1, 2):
        cart.next()
        assert cart.say("a", seq, lease=2.25 * PERIOD) == "ok"
    cart.next(2)
    state = cart.next()
    assert [(round(piece.seconds / PERIOD, 6), piece.u[0]) for piece in state.pieces] == [
        (0.75, 0.4),
        (0.25, 0.0),
    ]
    assert cart.shield.hand.ended == "the lease is over"
    assert cart.say("a", 3) == "ended"
    assert cart.say("b", 0) == "ok"
    assert cart.next(2).source == "manual"


def test_the_last_sender_has_precedence() -> None:
    cart = Cart()
    cart.next(2)
    assert cart.say("a", 0, 0.4) == "ok"
    cart.next()
    assert cart.say("b", 0, -0.4) == "ok"
    # The earlier sender can only renew an ended intention, which is refused.
    assert [cart.say("a", 1, 0.4), cart.say("a", 2, None), cart.say("b", 1, -0.4)] == ["ended", "ended", "ok"]
    cart.next()
    assert (cart.next().applied, cart.shield.hand.run_id) == ([-0.4, 0.0], "b")
    assert (cart.say("b", 0, 0.4), cart.say("c", 0, None)) == ("out of order", "ok")
    assert cart.say("b", 2) == "ended"
    assert cart.next().source == "command"
    assert cart.shield.hand.ended == "c gave it back"


def test_a_restarted_gateway_refuses_renewals() -> None:
    cart = Cart()
    cart.next(2)
    assert cart.say("a", 7) == "ended"
    assert cart.next(2).source == "command"


def test_a_new_origin_ends_it() -> None:
    cart = Cart()
    cart.next(2)
    cart.say("a", 0)
    cart.next(2)
    cart.shield.jump()
    cart.next()
    assert cart.shield.hand.ended == "the state is another one"
    assert cart.next().source != "manual"


def test_it_works_without_a_controller_and_the_safe_input_follows() -> None:
    cart = Cart()
    cart.commanded = None
    cart.next(2)
    cart.say("a", 0)
    states = [cart.next() for _ in range(3)]
    assert [state.source for state in states] == ["hold", "manual", "manual"]
    cart.say("a", 1, None)
    cart.next()
    assert cart.next().source == "safe"


def test_after_it_the_plan_continues_at_its_present_entry() -> None:
    cart = Cart()
    cart.next(3)
    cart.commanded = None
    cart.say("a", 0)
    cart.next(2)
    cart.say("a", 1, None)
    assert [cart.next().source for _ in range(3)] == ["plan", "safe", "safe"]


@pytest.mark.parametrize("u", [1.0, -1.0, 0.3])
def test_it_ends_in_time_before_the_plant_leaves_x(u: float) -> None:
    cart = Cart((0.2, 0.0))
    cart.next(2)
    cart.say("a", 0, u)
    seq, farthest = 0, 0.0
    while cart.shield.hand.acts:
        seq += 1
        x = np.array(cart.next().x)
        cart.commanded = _braking(x)
        cart.say("a", seq, u)
        assert cart.k < 500
    assert "would leave X within" in cart.shield.hand.ended
    # Repeated messages do not restart it; the controller brakes and needs the remaining distance.
    for _ in range(100):
        seq += 1
        assert cart.say("a", seq, u) == "ended"
        x = np.array(cart.next().x)
        cart.commanded = _braking(x)
        farthest = max(farthest, float(np.abs(x).max()))
    assert 0.5 < farthest < 1.0


def test_an_input_that_keeps_x_does_not_end_it() -> None:
    cart = Cart((0.2, 0.0))
    cart.next(2)
    cart.say("a", 0, 0.0)
    for seq in range(1, 300):
        cart.say("a", seq, 0.0)
        cart.next()
    assert cart.shield.hand.acts


def test_missing_measurements_are_predicted_for_a_limited_time() -> None:
    cart = Cart()
    cart.next(2)
    cart.blind = True
    cart.say("a", 0, 0.0)
    cart.next()
    assert cart.shield.hand.ended == "the state is not measured"
    cart.blind = False
    cart.say("b", 0, 0.0)
    cart.next()
    cart.blind = True
    blind = 0
    while cart.shield.hand.acts:
        blind += 1
        cart.say("b", blind, 0.0)
        cart.next()
    # W is half a percent of X per period in one state and accumulates in the other.
    assert 10 < blind < 500
    assert "would leave X" in cart.shield.hand.ended


def test_a_plant_without_a_model_refuses_it() -> None:
    cart = Cart(way_back=None)
    cart.next(2)
    assert cart.say("a", 0) == "no model"
    assert cart.next(2).source == "command"


def test_the_check_handles_nonfinite_numbers() -> None:
    beyond = WAY_BACK.of(np.array([1e308, 1e308]))
    u = np.array([1e308, 1e308])
    assert WAY_BACK.lost(WAY_BACK.after(beyond, u), u)
    far = replace(CART, x_min=[-np.inf, -np.inf], x_max=[np.inf, np.inf], scale={"place": 1.0, "speed": 1.0})
    free = way_back_of(Config(rate=1.0 / PERIOD), far)
    u = np.array([1.0, 1.0])
    assert not free.lost(free.after(free.of(np.array([5.0, 3.0])), u), u)


def test_a_slow_actuator_ends_it_earlier() -> None:
    slow = replace(CART, u_rate_max=[1.0, 1.0])
    of_slow = _ended(slow, way_back_of(Config(rate=1.0 / PERIOD), slow), 0.3)
    assert of_slow[0] < _ended(CART, WAY_BACK, 0.3)[0] - 0.05


def test_a_row_of_states_ends_it_with_its_name() -> None:
    """The check includes rows; with the box alone the override would continue."""
    row = {"reach": {"place": 1.0, "speed": 0.1, "max": 0.25}}
    narrow = replace(CART, rows=row)
    there, u = np.array([0.2, 0.3]), np.array([0.3, 0.0])
    reasons = []
    for plant in (CART, narrow):
        way_back = way_back_of(Config(rate=1.0 / PERIOD), plant)
        reasons.append(way_back.lost(way_back.after(way_back.of(there), u), u))
    assert reasons[0] == ""
    assert reasons[1].startswith("reach would leave X within")


def test_inputs_within_the_dead_time_are_included() -> None:
    """At full speed towards the edge it ends earlier by the distance of two and a half periods."""
    late = 2.5 * PERIOD
    with_it, without = (_ended(replace(CART, dead_time=seconds), WAY_BACK, 0.2) for seconds in (late, 0.0))
    assert without[0] == pytest.approx(with_it[0] + late * with_it[1], abs=0.05)
