"""The controller between messages: it maps a Tick to its Command and all other outputs.

It is deterministic: the outputs depend on the configuration, the keyframe and the ticks only. The live node, the
lock-step simulation and the replay all call `step` and differ only in the source of the ticks.
"""

from __future__ import annotations

import hashlib
import platform

import msgspec
import numpy as np

from controller_node.build import GivenPlant, build_backup, build_controller, build_model
from controller_node.certified_sets import CertifiedSets, find_sets
from controller_node.codegen.compiler import Compiler
from controller_node.memory import Memory
from controller_node.translation import Outputs, Translation
from lbmpc.controller.backup_policy import BackupPlanner
from lbmpc.plants import Known
from node_runtime import provenance
from node_runtime.config.reference import is_reference
from node_runtime.config.sections import Config
from protocol import messages as m


def sha256_of_known(plant: Known) -> str:
    """Return the SHA-256 of all numbers and texts of a plant, to compare the knowledge of two processes."""
    return hashlib.sha256(msgspec.json.encode(plant.to_builtins(), order="sorted")).hexdigest()


class ControllerCore:
    """A controller with its memory.

    Args:
        config: the resolved configuration.
        run_id: written into every message; a replay uses the recorded one.
        sets: the certified sets of the tightening `invariant`; None to find them by the configuration.
        given: the plant; None for the configured one.

    Raises:
        ConfigError: the configuration allows no controller. The text says why.
    """

    def __init__(
        self,
        config: Config,
        run_id: str,
        sets: CertifiedSets | None = None,
        given: GivenPlant | None = None,
    ):
        self.config, self.run_id = config, run_id
        model = build_model(config, given)
        self.plant = model.plant
        self.sets = None
        if config.controller.tightening == "invariant":
            self.sets = find_sets(config, model) if sets is None else sets
        compiler = Compiler() if config.controller.solver.compile == "auto" else None
        certificate = self.sets.certificate if self.sets else None
        self.controller, self._solver = build_controller(config, model, compiler, certificate, given)
        self._realise = compiler
        self._backup: BackupPlanner | None = None
        self.kernels = compiler.note if compiler else "virtual machine, as configured"
        self.memory = Memory(self.controller, config, run_id)
        self.translation = Translation(run_id, self.plant, config.period)

    def step(self, tick: m.Tick) -> Outputs:
        """Run one control step. It never raises because of a tick's content."""
        self._solver.seconds = 0.0
        state, result = self.controller.step(self.memory.state, self.translation.observation(tick))
        self.memory.advance(state, result.new_network)
        network = self.controller.oracle.network(state.oracle)
        return self.translation.outputs(tick, result, network, self.memory.hidden_sha256)

    def prepare(self) -> None:
        """Use the time until the next tick, see `Controller.prepare`."""
        self.controller.prepare(self.memory.state)

    def backup(self, command: m.Command) -> m.Backup | None:
        """Return the policy to follow if no command arrives after `command`, that of the last step; None without one.

        Nothing else depends on this call, so it can be omitted.
        """
        policy = self.controller.backup(self._planner(), self.memory.state)
        return None if policy is None else self.translation.backup(policy, command)

    def ready_backup(self) -> None:
        """Build everything that the first call of `backup` would build."""
        state = self.memory.state
        theta = self.controller.oracle.theta(state.oracle)
        self._planner().policy(state.predicted, theta, state.plan.u)

    def ready_targets(self) -> None:
        """Build everything that the first reference would build, because the loop has no time for it."""
        model, aims = self.controller.model, self.controller.aims
        if aims.targets is not None:
            theta = self.controller.oracle.theta(self.memory.state.oracle)
            aims.targets.find(theta, np.zeros(model.d + model.m), (), np.zeros(0))

    def _planner(self) -> BackupPlanner:
        if self._backup is None:
            self._backup = build_backup(self.config, self.controller.problem, self._realise)
        return self._backup

    @property
    def solve_seconds(self) -> float:
        """Duration of the last step's solve on this machine; 0 without one."""
        return self._solver.seconds

    def certified_sets(self) -> m.CertifiedSets | None:
        """Return the sets in use for the log; None without any."""
        if self.sets is None:
            return None
        return m.CertifiedSets(
            run_id=self.run_id,
            seq=0,
            kind=self.sets.certificate.kind,
            sha256=self.sets.sha256,
            content=self.sets.to_bytes(),
        )

    def arithmetic(self) -> dict[str, str]:
        """Return the properties that may change the last digits of numbers on another machine, by name."""
        return {"machine": platform.machine(), "kernels": self.kernels, **provenance.arithmetic()}

    def run_info(self, unix_time: float) -> m.RunInfo:
        """Return the facts that a self-contained log needs for a replay."""
        facts = self.arithmetic() | {"known plant": sha256_of_known(self.plant)}
        if self.sets is not None:
            facts |= {"certified sets": self.sets.sha256}
        network = self.controller.oracle.description
        if network is not None and is_reference(network.architecture):
            facts |= {"architecture": network.architecture}
        return provenance.run_info(
            self.config,
            "controller",
            self.run_id,
            self.plant.units,
            packages=provenance.CONTROLLER,
            facts=facts,
            unix_time=unix_time,
        )
