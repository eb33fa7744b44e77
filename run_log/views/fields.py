"""Meanings and units of the fields of the views."""

from __future__ import annotations

from typing import NamedTuple


class Meaning(NamedTuple):
    """Meaning of one field."""

    text: str
    unit: str = ""
    """Empty if it has none, or if its entries have the units of the plant's states and inputs."""


FIELDS: dict[str, Meaning] = {
    "run_id": Meaning("Run of the process that sent the message"),
    "seq": Meaning("Number of the message in that run; of a controller the tick"),
    "t": Meaning("Time of the sample on the plant's own clock", "s"),
    "x": Meaning("State"),
    "u": Meaning("Input"),
    "applied": Meaning("Input that acted over the last period, its time average"),
    "pieces": Meaning("Inputs that acted in the last period, in order, where there was more than one"),
    "seconds": Meaning("For how long this input acted", "s"),
    "source": Meaning("What drove the plant: hold, command, plan, safe or manual"),
    "held": Meaning("The input was held at its initial value, as it is before the first command"),
    "missing": Meaning("States that the sample does not have; their entries of x count nothing"),
    "command_seq": Meaning("Tick of the last command that the plant received; -1 before the first"),
    "state_run_id": Meaning("Run of the plant whose sample the command answers"),
    "state_seq": Meaning("Number of the sample that it answers; -1 for none"),
    "period": Meaning("Time between two entries of the plan", "s"),
    "mode": Meaning("Where the command comes from: solver, shifted_plan or feedback"),
    "plan": Meaning("Inputs for this period and those that follow; the first is u"),
    "slot": Meaning("Slots since the loop began: ticks and skipped slots"),
    "skipped": Meaning("Slots missed just before this one"),
    "lateness": Meaning("Time between the planned and the real start of the tick", "s"),
    "late": Meaning("The tick started late"),
    "state_verdict": Meaning("Whether the sample was fresh, stale or missing"),
    "weights_version": Meaning("Version of the hidden weights that arrived since the tick before"),
    "status": Meaning("How the solver ended"),
    "iterations": Meaning("Iterations of the solver"),
    "slack": Meaning("Largest violation of a state constraint in the nominal plan, in half-widths", "1"),
    "slack_row": Meaning("Constraint with that violation"),
    "h": Meaning("Measured model error: x(t) - A x(t-1) - B u(t-1), deviations from the equilibrium"),
    "h_hat": Meaning("The oracle's estimate of h, from before it saw this sample"),
    "prediction_error": Meaning("Euclidean norm of h_hat - h"),
    "oracle_norms": Meaning("Norm of each column of K, scaled outputs"),
    "hidden_version": Meaning("Version of the hidden weights in use; -1 before the first"),
    "hidden_sha256": Meaning("Hash of the hidden weights in use"),
    "input_delay": Meaning("Time for which the state was predicted ahead before the problem was solved", "s"),
    "weights_verdict": Meaning(
        "Outcome of the hidden weights on offer: none, adopted, or refused with a reason"
    ),
    "weights_rolled_back": Meaning("Why the previous hidden weights came back in this tick"),
    "set_margin": Meaning(
        "Distance to the boundary of the certified sets, in half-widths; negative outside", "1"
    ),
    "set_piece": Meaning("Which of the certified sets the state is in; -1 for none"),
    "sensor_faults": Meaning("Sensor faults, by state: the kind of fault, and how the state is still known"),
    "reference": Meaning("Where the outputs should be in this tick"),
    "reference_verdict": Meaning("Outcome of the tick's reference: taken, or refused with a reason"),
    "reference_from": Meaning("Run of the sender of that reference"),
    "weight": Meaning("Share of the network's estimate that counts in the prediction, by state", "1"),
    "constant_weight": Meaning("Share of the learned constant that counts beside it, by state", "1"),
    "deviation": Meaning("Standard deviation of the estimated state"),
    "noise": Meaning("Standard deviation of the measurement noise that the estimator found"),
    "solve_ms": Meaning("Time that the solver took", "ms"),
    "tick_ms": Meaning("Time that the whole tick took", "ms"),
    "lateness_ms": Meaning("Time between the planned and the real start of the tick", "ms"),
    "state_age_ms": Meaning("Age of the sample at the start of the tick", "ms"),
    "count": Meaning("Samples in the batch; x, u and h are those of the last one"),
    "norm": Meaning("Frobenius norm of K, scaled outputs"),
    "column_norms": Meaning("Norm of each column of K, scaled outputs"),
    "for_run": Meaning("Run of the controller that the weights were trained for"),
    "trained_on": Meaning("Tick of the output weights that were held fixed in the training"),
    "newest": Meaning("Number of the newest sample in the training; -1 for none"),
    "base_sha256": Meaning("Hash of the hidden weights that the training began with"),
    "samples": Meaning("Samples that the training drew"),
    "loss_before": Meaning("Loss before the training"),
    "loss_after": Meaning("Loss after the training"),
    "sha256": Meaning("Hash of the content"),
    "layer_norms": Meaning("Frobenius norm of each hidden layer, W_1 first"),
    "lease": Meaning("Time for which the message counts if it is not repeated", "s"),
    "kind": Meaning("Kind of the content"),
    "times": Meaning("Times of the reference's points, from the tick that takes it", "s"),
    "values": Meaning("Outputs at these times"),
    "process": Meaning("Name of the process"),
    "versions": Meaning("Versions of the packages in use"),
    "seed": Meaning("Seed of everything random"),
    "units": Meaning("Units of the plant's states, inputs and of time"),
    "unix_time": Meaning("When the process began, Unix time on its own machine", "s"),
    "counters": Meaning("Counters of the process since it began"),
    "note": Meaning("A note for people"),
    "Tick.t": Meaning("Planned time of the tick, from when the loop began", "s"),
    "Tick.x": Meaning("State of the sample that the tick latched"),
    "Samples.x": Meaning("State of the last sample, deviation from the equilibrium"),
    "Samples.u": Meaning("Input of the last sample, deviation from the equilibrium"),
    "Samples.h": Meaning("Label of the last sample, h(x, u)"),
    "Override.mode": Meaning("manual: a person drives the plant; auto: no longer"),
    "Reference.kind": Meaning(
        "set: outputs go to values; hold: the plant stays; configured: as the configuration"
    ),
    "Health.status": Meaning("starting, ready, running, stopping or failed"),
    "targets.x": Meaning("State that the plan aims at: the target, or the equilibrium where there is none"),
    "targets.u": Meaning("Input that goes with it"),
    "targets.status": Meaning(
        "none: no reference; reached, nearest or no rest: how near the target can come"
    ),
    "targets.distance": Meaning("Largest distance of an output from its reference, in half-widths", "1"),
    "bounds.x_min": Meaning("Lower bounds of the states"),
    "bounds.x_max": Meaning("Upper bounds of the states"),
    "bounds.u_min": Meaning("Lower bounds of the inputs"),
    "bounds.u_max": Meaning("Upper bounds of the inputs"),
    "bounds.u_rate_max": Meaning("Largest rates of change of the inputs, per second"),
    "bounds.h_min": Meaning("Lower bounds of h: minus the half-widths of W for one period"),
    "bounds.h_max": Meaning("Upper bounds of h: the half-widths of W for one period"),
}
"""By field name, or by "message.field" if the meaning differs in one message."""


def meaning_of(message: str, field: str) -> Meaning:
    """Return the meaning of a field of a message (`TickResult`) or of a series (`targets`)."""
    return FIELDS.get(f"{message}.{field}") or FIELDS[field]
