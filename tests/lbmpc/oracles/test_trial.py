"""The trial of hidden weights: refusals, rollbacks, and no effect on ordinary training."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from controller_node.build import describe_trial
from controller_node.core import ControllerCore
from lbmpc.oracles import DnnOracle
from lbmpc.oracles.base import HiddenSet, OracleState, Verdict
from lbmpc.oracles.dnn.adoption import IN_USE, NEWEST
from lbmpc.oracles.dnn.trial import TRIED, Finding, Trial, empty, had, newest, remember, tried
from network_model.description import hash_layers
from node_runtime.config.loading import load, override
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from run_log.replaying.replay import replay
from run_log.reporting.summary import Summary, summarise
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import follow, simulate
from tests.helpers.science import compressor, describe
from verification.attacks import Forge, Known, crude, drift, elsewhere, follow_attacked, noise

STEPS = 200
TRIAL = Trial(capacity=40, stride=1, window=20)
MODEL = compressor()
ORACLE = DnnOracle(describe(MODEL, [8, 8]), trial=TRIAL)
Layers = list[np.ndarray]


# -- the rule ------------------------------------------------------------------------------------------------


def test_the_comparison_has_a_margin_and_a_floor() -> None:
    trial = Trial(40, 1, 20, margin=0.2, floor=0.01, floor_after=0.1)
    assert not trial.refuses(Finding(1.19, 1.0, 40))
    assert trial.refuses(Finding(1.21, 1.0, 40))
    # Rounding must not make two almost perfect networks refuse each other.
    assert not trial.refuses(Finding(0.9e-4, 1e-12, 40))
    assert trial.refuses(Finding(1.1e-4, 1e-12, 40))
    assert not trial.regrets(Finding(0.9e-2, 1e-12, 40))
    assert trial.regrets(Finding(1.1e-2, 1e-12, 40))
    assert trial.refuses(Finding(np.nan, 1.0, 40))
    assert trial.regrets(Finding(np.nan, 1.0, 40))


@pytest.mark.parametrize("stride", [1, 3])
def test_the_ring_holds_the_newest_samples(stride: int) -> None:
    trial = Trial(capacity=5, stride=stride, window=8)
    state = empty(trial, 1)
    for number in range(23):
        state |= remember(trial, state, np.array([float(number)]))
    kept = [number for number in range(23) if number % stride == 0][-5:]
    assert sorted(newest(trial, state)[:, 0]) == kept
    assert sorted(newest(trial, state, since=18)[:, 0]) == [number for number in kept if number >= 18]


@pytest.mark.parametrize(
    ("settings", "time_scale", "stride", "window"),
    [
        (["rate=20"], 1.0, 1, 20),
        (["rate=1000"], 1.0, 50, 1000),
        (["rate=1000"], 0.25, 12, 250),
        (["rate=10"], 64.0, 32, 640),
        # The minimum number of samples applies if a time scale has few.
        (["rate=2"], 1.0, 1, 20),
        (["rate=20", "adaptation.trial.seconds=20.0", "adaptation.trial.confirm=0.1"], 64.0, 5, 8),
    ],
)
def test_a_trial_is_in_time_scales_of_the_plant_or_in_seconds(
    settings: list[str], time_scale: float, stride: int, window: int
) -> None:
    trial = describe_trial(override(Config(), settings), time_scale)
    assert trial == Trial(80, stride, window, margin=0.2, floor=0.003, floor_after=0.1)


def test_a_trial_can_be_disabled_and_needs_samples() -> None:
    assert describe_trial(override(Config(), ["adaptation.trial.enabled=false"]), 1.0) is None
    with pytest.raises(ConfigError, match="samples"):
        override(Config(), ["adaptation.trial.samples=3"])


# -- one oracle ----------------------------------------------------------------------------------------------


def learned(samples: int, oracle: DnnOracle = ORACLE, spread: float = 0.1) -> OracleState:
    """Return the state after that many samples of a smooth h about the equilibrium."""
    rng = np.random.default_rng(0)
    state = oracle.initial_state(rng)
    for _ in range(samples):
        state = more(oracle, state, rng.normal(size=4) * spread)
    return state


def more(oracle: DnnOracle, state: OracleState, x: np.ndarray) -> OracleState:
    return oracle.learn(state, x, np.array([0.1]), 0.01 * np.array([x[0] + 0.3, x[1], 0.0, 0.2]))


def offer(
    oracle: DnnOracle, state: OracleState, layers: Layers, version: int, later: int | None = None
) -> tuple[OracleState, Verdict]:
    layers = [layer.astype(np.float32).astype(float) for layer in layers]
    offered = HiddenSet(version, layers, hash_layers(layers), oracle.description.sha256(), later)
    return oracle.adopt(state, offered)


def nudged(hidden: Layers) -> Layers:
    """Return layers that are as good but not the same."""
    return [layer * (1 + 1e-5) for layer in hidden]


def assert_as_it_was(after: OracleState, state: OracleState) -> None:
    """Assert equality except for the memory of trials."""
    assert after.keys() == state.keys()
    for name in state.keys() - {"tried"}:
        assert after[name] is state[name], name


def test_no_trial_without_samples() -> None:
    state = learned(9)
    after, verdict = offer(ORACLE, state, ORACLE.hidden(state), 1)
    assert verdict == Verdict("refused", "trial: 9 samples so far, 10 are needed")
    assert after is state


@pytest.mark.parametrize("architecture", ["mlp", "rnn", "cnn"])
def test_a_worse_set_is_refused_with_both_errors(architecture: str) -> None:
    oracle = DnnOracle(describe(MODEL, [8, 8], architecture=architecture), trial=TRIAL)
    state = learned(60, oracle)
    hidden = oracle.hidden(state)
    after, verdict = offer(oracle, state, [*hidden[:-1], -hidden[-1]], 1)
    assert verdict.outcome == "refused"
    assert verdict.reason.startswith("trial: error ")
    assert " against " in verdict.reason
    assert_as_it_was(after, state)
    adopted, verdict = offer(oracle, state, nudged(hidden), 1)
    assert verdict.outcome == "adopted"
    np.testing.assert_array_equal(adopted["K"], state["K"])
    assert list(adopted["version"]) == [1, 1]


def _worse_elsewhere(state: OracleState) -> Layers:
    """Return layers with a unit that acts like a constant at the samples and changes sign above z = 0.2."""
    hidden = [layer.copy() for layer in ORACLE.hidden(state)]
    hidden[0][:, 0] = 0.0
    hidden[0][0, 0], hidden[0][1, 0] = -8.0, 40.0
    hidden[1][0, :] += 0.5
    hidden[1][1, :] = 0.5
    return hidden


def test_a_set_with_known_training_samples_must_pass_on_later_samples() -> None:
    state = learned(60, spread=0.01)
    rng = np.random.default_rng(1)
    for _ in range(28):
        # The labels are so noisy that a comparison on them shows nothing.
        h = 10.0 * ORACLE.output_scale * rng.normal(size=4)
        state = {**ORACLE.learn(state, rng.normal(size=4) * 0.01, np.array([0.1]), h), "K": state["K"]}
    for _ in range(12):
        state = {**more(ORACLE, state, np.array([0.4, 0.0, 0.0, 0.0])), "K": state["K"]}
    worse = _worse_elsewhere(state)
    after, verdict = offer(ORACLE, state, worse, 1, later=12)
    assert verdict.outcome == "refused"
    assert "of 12 samples" in verdict.reason
    assert_as_it_was(after, state)
    # Too few later samples decide nothing, and neither does a set without information.
    assert offer(ORACLE, state, worse, 1, later=9)[1].outcome == "adopted"
    assert offer(ORACLE, state, worse, 1)[1].outcome == "adopted"
    # An age beyond the memory means all stored samples.
    assert offer(ORACLE, state, worse, 1, later=2**62)[1].outcome == "adopted"


def test_a_set_that_proves_worse_is_rolled_back_with_K() -> None:
    state = learned(60, spread=0.01)
    before = {name: state[name].copy() for name in ("W1", "W2", "K")}
    state, verdict = offer(ORACLE, state, _worse_elsewhere(state), 7)
    assert verdict.outcome == "adopted", verdict
    assert ORACLE.confirm(state) == (state, "")
    said = ""
    for _ in range(TRIAL.window):
        state, said = ORACLE.confirm(more(ORACLE, state, np.array([0.4, 0.0, 0.0, 0.0])))
        if said:
            break
    assert said.startswith("version 7 back to version 0: error ")
    for name, array in before.items():
        np.testing.assert_array_equal(state[name], array)
    assert int(state["version"][IN_USE]) == 0
    # The next set must have a higher version than the one that was rolled back.
    assert int(state["version"][NEWEST]) == 7
    assert offer(ORACLE, state, ORACLE.hidden(state), 7)[1] == Verdict(
        "refused", "version 7 is not newer than 7"
    )
    assert offer(ORACLE, state, nudged(ORACLE.hidden(state)), 8)[1].outcome == "adopted"


def test_a_good_set_is_confirmed_and_its_predecessor_dropped() -> None:
    state = learned(60)
    state, verdict = offer(ORACLE, state, nudged(ORACLE.hidden(state)), 1)
    assert verdict.outcome == "adopted"
    for _ in range(TRIAL.window):
        assert state["watch"][0] == 1
        state, said = ORACLE.confirm(more(ORACLE, state, np.full(4, 0.01)))
        assert said == ""
    assert not state["watch"].any()
    assert not state["before.W1"].any()


def test_an_earlier_set_is_refused_under_any_version() -> None:
    """This applies to sets that were initial, adopted and replaced, refused, or rolled back."""
    state = learned(60)
    first = ORACLE.hidden(state)
    second, third = nudged(first), nudged(nudged(first))
    worse = [*first[:-1], -first[-1]]
    for version, layers in ((1, second), (2, third)):
        state, verdict = offer(ORACLE, state, layers, version)
        assert verdict.outcome == "adopted"
    state, verdict = offer(ORACLE, state, worse, 3)
    assert verdict.outcome == "refused"
    assert verdict.reason.startswith("trial: ")
    for layers in (first, second, third, worse):
        after, verdict = offer(ORACLE, state, layers, 9)
        assert verdict.outcome == "refused"
        assert verdict.reason.startswith("stale: ")
        assert after is state
    assert offer(ORACLE, state, nudged(third), 9)[1].outcome == "adopted"


def test_the_memory_of_trials_is_bounded() -> None:
    state = learned(60)
    old = ORACLE.hidden(state)
    for _ in range(TRIED):
        assert tried(state, hash_layers(old))
        state = {**state, **had(state, f"{len(state):064x}")}
    assert not tried(state, hash_layers(old))
    assert len(state["tried"]) == TRIED


def test_a_huge_version_does_not_block_later_sets() -> None:
    state = learned(60)
    assert "leaps too far" in offer(ORACLE, state, ORACLE.hidden(state), 2**62)[1].reason


# -- the closed loop with a malicious trainer ----------------------------------------------------------------


@cache
def calm() -> Summary:
    return summarise(simulate(load(None, ["seed=0"]), STEPS))


@pytest.mark.parametrize(
    ("forge", "every", "instead"),
    [
        pytest.param(crude, 1, False, marks=pytest.mark.long),
        (noise(0.1), 1, False),
        pytest.param(noise(0.1), 1, True, marks=pytest.mark.long),
        (drift, 7, False),
        pytest.param(elsewhere(1.0), 1, False, marks=pytest.mark.long),
    ],
    ids=["crude", "10 % noise", "10 % noise on every trained set", "drift", "right here and wrong elsewhere"],
)
def test_a_malicious_trainer_does_not_affect_the_plant(forge: Forge, every: int, instead: bool) -> None:
    summary = summarise(follow_attacked(load(None, ["seed=0"]), STEPS, forge, every, instead))
    assert summary.J < 1.05 * calm().J
    assert summary.constraint_violations == 0
    assert summary.fallback_ticks == 0
    if forge is crude:
        assert summary.weights_refused >= 180
        assert summary.weights_adopted == calm().weights_adopted
        assert summary.J == calm().J


def test_ordinary_training_is_neither_refused_nor_rolled_back() -> None:
    assert calm().weights_refused == 0
    assert calm().weights_rolled_back == 0


# These settings accept every set before adoption and none after it, so adopted sets are rolled back.
LOOSE = ["adaptation.trial.floor=1.0", "adaptation.trial.floor_after=0.0", "adaptation.trial.margin=0.0"]
SMALL = ["controller.horizon=15", "controller.keyframe_every=10", "network.hidden=[8, 8]", "trainer.steps=20"]


def test_refusals_and_rollbacks_replay_from_the_start_and_from_a_keyframe() -> None:
    run = follow_attacked(override(Config(), [*SMALL, *LOOSE]), 100, noise(0.3), 9)
    back = [result.seq for result in run.results if result.weights_rolled_back]
    assert back
    assert replay(run).equal
    for tick in back[:2]:
        result = replay(run, from_tick=tick)
        assert result.equal, result.first_difference
        assert result.first_tick <= tick
    # A different rule gives a different run, and the comparison detects it.
    assert not replay(run, None, ["adaptation.trial.floor=0.0"]).equal


def test_a_tick_contains_the_number_of_later_samples_and_replays() -> None:
    noisy = ["estimator.kind=kalman", "estimator.noise=0.001", "plant.sensors.noise=0.001"]
    config = override(Config(), [*SMALL, *noisy])
    run = follow(config, 60, Faults(training_seconds=0.3)).run
    core = ControllerCore(config, "controller-simulated")
    offered = [(tick, core.translation.observation(tick).hidden) for tick in run.ticks if tick.weights]
    assert offered
    for tick, hidden in offered:
        assert hidden is not None
        # The set was trained in the tick that learned its last sample, six ticks before.
        assert hidden.later == 6
        assert tick.weights.newest == tick.seq - 7
    assert replay(run).equal
    assert replay(run, from_tick=45).equal


def test_stale_sets_are_refused_in_a_replay_from_a_keyframe() -> None:
    heard: list[Layers] = []

    def stale(known: Known, _rng: np.random.Generator) -> Layers:
        heard.append(known.good)
        return heard[0]

    run = follow_attacked(override(Config(), SMALL), 100, stale, 3)
    refused = [r.seq for r in run.results if r.weights_verdict.startswith("refused: stale")]
    assert len(refused) == sum(
        bool(tick.weights and tick.weights.run_id == "stolen") for tick in run.ticks[11:]
    )
    assert replay(run, from_tick=refused[-1]).equal


def test_after_a_rollback_newest_version_and_present_hash_are_published() -> None:
    run = follow_attacked(override(Config(), [*SMALL, *LOOSE]), 100, noise(0.3), 9)
    back = next(result for result in run.results if result.weights_rolled_back)
    told = next(weights for weights in run.output_weights if weights.seq == back.seq)
    assert told.hidden_sha256 == back.hidden_sha256
    assert told.hidden_version >= back.hidden_version
    assert run.results[back.seq - 1].hidden_sha256 != back.hidden_sha256


def test_a_keyframe_contains_the_trial() -> None:
    config = override(Config(), SMALL)
    core = ControllerCore(config, "controller-a")
    arrays = core.memory.keyframe(-1).arrays
    assert {
        "oracle.recent",
        "oracle.seen",
        "oracle.watch",
        "oracle.tried",
        "oracle.before.K",
        "oracle.before.W1",
    } <= arrays.keys()
    core.memory.restore(core.memory.keyframe(-1))
