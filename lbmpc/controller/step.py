"""One control step as a pure function, used live, in lock-step simulation and in replay.

The order within a step makes a swap of hidden weights correct. First the label of the previous input is learned with
the features phi_j under which that input was applied. Then bad hidden weights may be rolled back and new ones adopted.
Then the problem is solved.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from lbmpc.controller.aims import Aim, Aims
from lbmpc.controller.backup_policy import BackupPlanner, Policy
from lbmpc.controller.dead_time import Acted, InputLine, acting, predicted
from lbmpc.controller.fallback import Plan, empty_plan, shift, without_solution
from lbmpc.controller.signals import Label, Mode, Observation, StepResult
from lbmpc.controller.state import ControllerState
from lbmpc.estimator.base import Estimate, Estimator, EstimatorState, Measured, Samples
from lbmpc.model import Model
from lbmpc.oracles.base import OracleState, Verdict, follow
from lbmpc.problem import Problem
from lbmpc.references import Reference
from lbmpc.sets.guard import FirstInputs
from lbmpc.sets.motion import LATEST, motion_of
from lbmpc.solver.constraint_rows import Box
from lbmpc.solver.solution import Solution
from lbmpc.targets import TargetSelector

DELAY_GAIN = 0.2
"""Share of a newly measured delay in the average. Averaging over a few ticks evens out the scheduler's noise."""


class Solves(Protocol):
    """The solver's interface, implemented by `lbmpc.solver.gauss_newton.Solver` and its replacements."""

    def solve(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        first: Box | None = None,
        previous: np.ndarray | None = None,
    ) -> Solution: ...

    def prepare(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        previous: np.ndarray | None = None,
    ) -> None: ...

    def feedback(
        self, x: np.ndarray, first: Box | None = None, previous: np.ndarray | None = None
    ) -> Solution: ...


ABSURD = 1e6
"""Half-widths from the equilibrium. A larger number is neither a measurement nor an input. A test for finite numbers is
not enough, because learning from 1e307 and predicting from it do not give finite results."""


class Controller:
    """LBMPC with an oracle that learns.

    Args:
        problem: the optimisation problem.
        solver: its solver.
        real_time: True for one prepared Gauss-Newton step per tick instead of solving to convergence.
        input_delay: seconds from a sample until its command acts, used until the plant reports one.
        targets: finds the targets of plans. With None every plan leads to the equilibrium.
        reference: the configured reference, until another is given; None means the equilibrium.
        estimator: computes the state from measurements; None if a sample is the state.
    """

    def __init__(
        self,
        problem: Problem,
        solver: Solves,
        real_time: bool = False,
        input_delay: float = 0.0,
        targets: TargetSelector | None = None,
        reference: Reference | None = None,
        estimator: Estimator | None = None,
    ):
        self.problem, self._solver, self.real_time = problem, solver, real_time
        self._prepared_for: ControllerState | None = None
        self._prepared_aim = Aim()
        self.model: Model = problem.model
        self.line = InputLine(self.model.plant, self.model.period)
        self.aims = Aims(self.model, problem.horizon, targets, reference)
        self._first_delay = self._acceptable(input_delay)
        guard = problem.guard
        self._motion = None if guard is None else motion_of(self.model, guard.certificate)
        self.oracle = problem.oracle
        self.estimator = Samples(self.model.d) if estimator is None else estimator
        plant = self.model.plant
        self._absurd = ABSURD * plant.x_scale, ABSURD * plant.u_scale

    def initial_state(self, seed: int) -> ControllerState:
        """Return the state before the first tick, with the oracle's random initial weights from the seed."""
        oracle = self.oracle.initial_state(np.random.default_rng(seed))
        plan = empty_plan(self.problem.horizon, self.model.m)
        nothing = np.zeros(self.model.d)
        s = self._with_past(oracle, nothing)
        target = self.aims.nothing_yet
        memory = self.estimator.initial_state()
        plant, line = self.model.plant, self.line.initial_state()
        commanded = plant.safe_input - plant.u_e if self.problem.looks_back else np.zeros(0)
        return ControllerState(
            plan, nothing, (0, -1), s, self._first_delay, oracle, target, memory, commanded, line
        )

    def prepare(self, state: ControllerState) -> None:
        """Linearise about the predicted state, which is the first part of the next step from this state.

        Call it between two samples to save time. It does not change the result: a step without preparation prepares
        itself, with the same numbers.
        """
        if self._prepares(state) and self._prepared_for is not state:
            theta = self.oracle.theta(state.oracle)
            self._prepared_aim = aim = self._aim(state, state.reference, theta, state.delay)
            self._solver.prepare(
                state.predicted, theta, state.plan.c, *aim.references, previous=_known(state.commanded)
            )
            self._prepared_for = state

    def backup(self, planner: BackupPlanner, state: ControllerState) -> Policy | None:
        """Return the policy to follow from the next period on if no command arrives.

        The result is None if this step followed no solution. It is also None with a dead time, because a stiff K can be
        unstable when its feedback is late. The plan is followed instead.
        """
        if state.plan.left == 0 or self.line.dead_time:
            return None
        theta = self.oracle.theta(state.oracle)
        aim = self._aim(state, state.reference, theta, state.delay, new=False)
        previous = _known(state.commanded)
        return planner.policy(state.predicted, theta, state.plan.u, *aim.references, previous=previous)

    def step(self, state: ControllerState, seen: Observation) -> tuple[ControllerState, StepResult]:
        """Run one tick: learn, adopt, solve, plan. It never raises because of its numbers."""
        written = self._without_absurd(seen)
        line, acted = self.line.advance(state.line, written, state.delay)
        estimator, seen, estimate = self._estimate(state, acted)
        label, oracle = self._learn(state, seen, estimate, acted.known)
        rolled_back = ""
        if label is not None:
            oracle, rolled_back = self.oracle.confirm(oracle)
        verdict = Verdict("none")
        if seen.hidden is not None:
            oracle, verdict = self.oracle.adopt(oracle, seen.hidden)
        if seen.truth:
            oracle = self.oracle.told(oracle, seen.truth)
        delay = self._delay(state.delay, written)
        start, there = self._when_it_acts(oracle, seen.x, acted, acting(written), delay)
        guard = self.problem.guard
        first = None if guard is None or start is None else guard.first_inputs(start)
        # A prepared step uses what was known when it was prepared.
        theta = None if self._prepares(state) else self.oracle.theta(oracle)
        x = state.predicted[: self.model.d] if seen.x is None else seen.x
        reference = self.aims.latched(state.reference, seen.reference, seen.skipped, x, state.target)
        if theta is None:
            self.prepare(state)
            aim = self._prepared_aim
        else:
            aim = self._aim(state, reference, theta, delay)
        s = state.predicted if start is None else self._with_past(there, start)
        previous = self._previous(state, written)
        plan, mode, solution = self._plan(state, theta, None if start is None else s, first, aim, previous)
        pending_x, pending = (
            (seen.x, (seen.source, seen.sequence)) if seen.x is not None else (state.pending_x, (0, -1))
        )
        x, u = s[: self.model.d], plan.u[0]
        after = follow(s, u, self.model.step(x, u) + self.oracle.estimate(there, x, u))
        if not np.isfinite(after).all():
            after = s
        estimator, line = self.estimator.commanded(estimator, u), self.line.commanded(line, u)
        memory = ControllerState(
            shift(plan),
            pending_x,
            pending,
            after,
            delay,
            oracle,
            aim.xu,
            estimator,
            u if self.problem.looks_back else state.commanded,
            line,
            None if reference is None else reference.advanced(1),
        )
        return memory, StepResult(
            plan.u,
            mode,
            solution,
            label,
            verdict,
            rolled_back,
            delay,
            first,
            aim.target,
            weights=self.oracle.weights(oracle),
            deviation=self.estimator.deviation(estimator),
            sensor_faults=self.estimator.faults(estimator),
            noise=self.estimator.found_noise(estimator),
        )

    def _without_absurd(self, seen: Observation) -> Observation:
        most_x, most_u = self._absurd
        if seen.x is not None and not (np.abs(seen.x) <= most_x).all():
            x = np.where(np.abs(seen.x) <= most_x, seen.x, np.nan)
            seen = replace(seen, x=x if self.estimator.tells(x) else None)
        inputs = [u for _seconds, u in seen.pieces] + ([] if seen.applied is None else [seen.applied])
        if any(not (np.abs(u) <= most_u).all() for u in inputs):
            seen = replace(seen, applied=None, pieces=())
        return seen

    def _estimate(
        self, state: ControllerState, acted: Acted
    ) -> tuple[EstimatorState, Observation, Estimate | None]:
        """Return the estimator's memory, the observation with the estimate as x, and the estimate."""
        seen = acted.seen
        if seen.x is None:
            memory, delay = state.estimator, state.delay
            if seen.pieces:
                # With a dead time, the inputs that acted are not those that were commanded last.
                (seconds, first), (_, then) = seen.pieces[0], seen.pieces[-1]
                delay = seconds if len(seen.pieces) > 1 else 0.0
                memory = self.estimator.commanded(self.estimator.commanded(memory, first), then)
            return self.estimator.missed(memory, delay), seen, None
        measured = Measured(seen.x, seen.source, seen.sequence, seen.applied, seen.pieces)
        memory, estimate = self.estimator.update(state.estimator, measured)
        return memory, seen if estimate.x is seen.x else replace(seen, x=estimate.x), estimate

    def _learn(
        self, state: ControllerState, seen: Observation, estimate: Estimate | None, known: bool
    ) -> tuple[Label | None, OracleState]:
        source, sequence = state.pending
        follows = sequence >= 0 and seen.source == source and seen.sequence == sequence + 1
        if seen.x is None or estimate is None:
            return None, state.oracle
        if seen.applied is None or not follows or not known:
            # The past of x is not known at the start and after a gap.
            acts = acting(seen)
            u = np.zeros(self.model.m) if acts is None else acts
            return None, self.oracle.begin(state.oracle, seen.x, u)
        x, u = state.pending_x, seen.applied
        h = self.model.label(x, u, estimate.reached, seen.pieces)
        past, variance = self.oracle.past(state.oracle), estimate.variance
        label = Label(x, u, h, self.oracle.estimate(state.oracle, x, u), past, variance)
        return label, self.oracle.learn(state.oracle, x, u, h, variance)

    def _delay(self, delay: float, seen: Observation) -> float:
        """Average the delay from sample to command that the plant reports; at most half a period."""
        if seen.applied is None or len(seen.pieces) < 2:
            return delay
        measured = sum(seconds for seconds, _u in seen.pieces[:-1])
        return self._acceptable(delay + DELAY_GAIN * (measured - delay))

    def _acceptable(self, delay: float) -> float:
        return min(delay, LATEST * self.model.period)

    def _when_it_acts(
        self,
        oracle: OracleState,
        x: np.ndarray | None,
        acted: Acted,
        acts: np.ndarray | None,
        delay: float,
    ) -> tuple[np.ndarray | None, OracleState]:
        """Return the state, (d,), at which the computed command begins to act, and the oracle's state there.

        The state is None if it is not known. Until then the plant follows the inputs on their way to it and the
        present input of the gateway. The prediction uses them; otherwise every millisecond between sample and command
        would count as a disturbance. With certified sets `lbmpc.sets.motion` predicts without the oracle. The sets are
        evaluated at this state and hold for any oracle, so an oracle's error must not enter it.
        """
        inputs = acted.ahead if acts is None or delay == 0.0 else (*acted.ahead, (delay, acts))
        if x is None or not inputs:
            return x, oracle
        if self._motion is not None and acts is not None:
            there = self._motion.after(x, acts, delay)
            if there is not None:
                return there, oracle
        with np.errstate(all="ignore"):
            there, after = predicted(self.model, self.oracle, oracle, x, inputs)
        # The state is unknown if the oracle's prediction is not finite.
        return (there, after) if np.isfinite(there).all() else (None, oracle)

    def _aim(
        self,
        state: ControllerState,
        reference: Reference | None,
        theta: np.ndarray,
        delay: float,
        new: bool = True,
    ) -> Aim:
        """Return the aim of a plan that begins to act after the delay and the plant's dead time."""
        return self.aims.find(reference, theta, state.target, delay + self.line.dead_time, new)

    def _prepares(self, state: ControllerState) -> bool:
        """Whether the next step completes a prepared one. This needs a plan to start from."""
        return self.real_time and state.plan.left > 0

    def _plan(
        self,
        state: ControllerState,
        theta: np.ndarray | None,
        s: np.ndarray | None,
        certified: FirstInputs | None,
        aim: Aim,
        previous: np.ndarray | None,
    ) -> tuple[Plan, Mode, Solution | None]:
        first = None if certified is None else (certified.lower, certified.upper)
        solution = None
        if s is not None:
            solution = self._solve(state, theta, s, first, aim, previous)
            if solution.usable:
                return Plan(solution.u, solution.c, self.problem.horizon), "solver", solution
        x = None if s is None else s[: self.model.d]
        plan, mode = without_solution(self.model, state.plan, x, aim.xu, first, previous)
        return plan, mode, solution

    def _solve(
        self,
        state: ControllerState,
        theta: np.ndarray | None,
        s: np.ndarray,
        first: Box | None,
        aim: Aim,
        previous: np.ndarray | None,
    ) -> Solution:
        if theta is not None:
            return self._solver.solve(s, theta, state.plan.c, *aim.references, first=first, previous=previous)
        self.prepare(state)
        self._prepared_for = None
        return self._solver.feedback(s, first, previous)

    def _previous(self, state: ControllerState, written: Observation) -> np.ndarray | None:
        """Return the input before v_0, (m,), in U, as reported or as commanded; None if nothing depends on it."""
        if not self.problem.looks_back:
            return None
        acts = acting(written)
        return state.commanded if acts is None else self.model.plant.within_about(acts)

    def _with_past(self, oracle: OracleState, x: np.ndarray) -> np.ndarray:
        """Return s of `lbmpc.oracles.base`, (D,); it is x itself if the oracle has no window."""
        return x if self.oracle.pairs == 1 else np.concatenate([x, self.oracle.past(oracle).ravel()])


def _known(commanded: np.ndarray) -> np.ndarray | None:
    return commanded if commanded.size else None
