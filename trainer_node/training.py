"""The slow timescale: training of the hidden layers on the replay buffer, with output weights fixed at K_{T_k}.

The module is pure, without bus and clock. The same samples and output weights in the same order with the same seed give
the same hidden layers, bit for bit, on a CPU with one thread (`use_one_thread`).
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from msgspec import UNSET

from network_model.description import NetworkDescription, hash_layers, why_unacceptable
from node_runtime.config.sections import TrainerConfig
from protocol.messages import Array, HiddenWeights, OutputWeights, Sample, counter_name
from trainer_node.descent import Descent, Problem, descend
from trainer_node.network import Network, build_loss
from trainer_node.pace import GAIN, Pace, Worth
from trainer_node.replay_buffer import ReplayBuffer

BASES = 8
"""Number of stored sets of hidden layers, newest last. The controller's K must belong to one of them."""
LEAP = 1000
"""Increase of the version while another trainer sends weights too, larger than that trainer's increase meanwhile."""
HELD_OUT = 0.25
"""Share of the drawn samples that is held out with noisy labels."""
LEAST_VARIANCE = 1e-4
"""Smallest variance of a label, in (output scale)^2."""
FARTHEST = 10**8
"""Largest lead of a version over the adopted one. A controller refuses a lead of 1e9."""


def use_one_thread() -> None:
    """Make this process train on one CPU thread, which also fixes the order of every sum."""
    torch.set_num_threads(1)


class TrainerError(RuntimeError):
    """This machine cannot train as configured."""


def pick_device(wanted: str) -> torch.device:
    """Resolve "auto", "cpu" or "cuda". Raises `TrainerError` if CUDA is requested and not available."""
    available = torch.cuda.is_available()
    if wanted == "cuda" and not available:
        raise TrainerError(
            "trainer.device is 'cuda', but torch finds no CUDA device here; use 'auto' or 'cpu', "
            "or install the NVIDIA driver and a CUDA build of torch"
        )
    return torch.device("cuda" if available and wanted != "cpu" else "cpu")


@dataclass(frozen=True)
class Draw:
    """A training that has begun: its problem, and the message that it answers."""

    problem: Problem
    output: OutputWeights
    for_run: str
    newest: int
    """The last sample of that run that could be drawn, -1 if there is none."""


class Trainer:
    """Collects samples and trains the hidden layers.

    Args:
        description: the network.
        config: settings of buffer and training.
        seed: seed of the drawn samples and of the reservoir.
        run_id: this trainer's id, written into its messages.
        hidden: the controller's W_1..W_{L-1}, (1 + n_{i-1}, n_i) each.
        version: version of `hidden`; the first trained weights get the next one.

    Raises:
        ValueError: the hidden layers are not acceptable for this network.
        TrainerError: the device does not exist.
    """

    def __init__(
        self,
        description: NetworkDescription,
        config: TrainerConfig,
        seed: int,
        run_id: str,
        hidden: list[np.ndarray],
        version: int = 0,
    ):
        self.description = description
        self.config = config
        self.run_id = run_id
        self.version = version
        """Version of the newest hidden layers; it never decreases."""
        self.counters: Counter[str] = Counter()
        scale = description.input_scale * description.window
        self.buffer = ReplayBuffer(config.capacity, config.strategy, seed, scale)
        self._draws = np.random.default_rng([seed, 0xD8A3])
        self._network = Network(description, device=pick_device(config.device))
        self._bases: OrderedDict[str, list[np.ndarray]] = OrderedDict()
        self.worth: Worth | None = None
        """Benefit of the last training; None for exact labels."""
        self._fresh = self._waited = 0
        # 1 / (standard deviation of the newest labels in output scales), over sqrt d; None for exact labels.
        self._weights: np.ndarray | None = None
        self._latest: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=config.train_every)
        self._pace = Pace(config.train_every, config.capacity)
        self._step = 1
        self.resume(hidden, version)

    def resume(self, hidden: list[np.ndarray], version: int = 0) -> None:
        """Continue from the controller's hidden layers and drop the trained ones. Samples are kept.

        Args:
            hidden: W_1..W_{L-1}, (1 + n_{i-1}, n_i) each.
            version: their version; the next trained layers have a higher one.

        Raises:
            ValueError: they are not acceptable for this network.
        """
        why = why_unacceptable(self.description, hidden)
        if why is not None:
            raise ValueError(f"the hidden layers cannot be used: {why}")
        self._bases.clear()
        self._take(hidden)
        self.version = max(self.version, version)
        self._pace.hurry()

    def leap(self, heard: int = 0) -> None:
        """Leave gaps between versions from now on, because another trainer sends weights under the same name.

        The other trainer is a few versions ahead, and a controller refuses versions below those it received.

        Args:
            heard: the version that the controller decided on last. The next version is above it, unless it is so far
                ahead that no controller would accept that.
        """
        self._step = LEAP
        if heard <= self.version + FARTHEST:
            self.version = max(self.version, heard)

    def add(self, run_id: str, samples: Iterable[Sample]) -> int:
        """Offer samples of one controller run; invalid ones are counted and left out. Return how many are new."""
        batch = list(samples)
        try:
            new = self._add(run_id, batch)
        except ValueError:
            if len(batch) > 1:
                # Find the invalid ones by adding one sample at a time.
                return sum(self.add(run_id, [sample]) for sample in batch)
            new, batch = 0, []
            self.counters["bad_samples"] += 1
        self.counters["samples_met_before"] += len(batch) - new
        self.counters["samples"] += new
        self._fresh += new
        return new

    def _add(self, run_id: str, samples: list[Sample]) -> int:
        """Return how many samples are new. Raises `ValueError` without adding any if one is invalid."""
        if not samples:
            return 0
        rows = [[*itertools.chain.from_iterable(sample.past), *sample.x, *sample.u] for sample in samples]
        windows, labels = np.array(rows, dtype=np.float64), np.array([sample.h for sample in samples])
        weights = self._weights_for(np.array(samples[-1].variance)) if samples[-1].variance else None
        new = self.buffer.add(run_id, [sample.seq for sample in samples], windows, labels)
        if new:
            self._latest.extend(zip(windows, labels, strict=True))
        self._weights = weights
        return new

    def _weights_for(self, variance: np.ndarray) -> np.ndarray:
        """Return weights of the states, (d,), with which labels of this variance, (d,), contribute 1 to the loss.

        All states contribute equally. Raises `ValueError` for an invalid variance.
        """
        if variance.shape != (self.description.states,):
            raise ValueError("no variance")
        with np.errstate(over="ignore"):
            noise = variance / np.array(self.description.output_scale) ** 2
        if not ((noise >= 0.0) & np.isfinite(noise)).all():
            raise ValueError("no variance")
        return 1.0 / np.sqrt(len(noise) * np.maximum(noise, LEAST_VARIANCE))

    def due(self, output: OutputWeights) -> bool:
        """Return whether enough new samples arrived since the last training; with noisy labels `Pace` decides.

        output: the newest output weights, used for the loss on new samples.
        """
        if self._fresh < self.config.train_every or len(self.buffer) < self.config.min_samples:
            return False
        if self._weights is None or self._pace.over(self._fresh):
            return True
        if self._pace.must_look(self._fresh):
            self._pace.look(self._loss_on_latest(output))
        return self._pace.over(self._fresh)

    def _loss_on_latest(self, output: OutputWeights) -> float:
        """Return the loss of the hidden layers that K belongs to; 0 if K is not usable."""
        K = output.K.numpy()
        if self._unusable(K, output.hidden_sha256) is not None:
            return 0.0
        self._network.load(self._bases[output.hidden_sha256])
        windows, h = (np.array(part) for part in zip(*self._latest, strict=True))
        return build_loss(self._network, windows, *self._weighted(h, K)).value()

    def _weighted(self, h: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return labels, (n, d), and output weights, (1 + n_L, d), with each state's weight in the loss."""
        weights = 1.0 if self._weights is None else self._weights
        with np.errstate(over="ignore"):
            return h * weights, K * weights

    def train(self, output: OutputWeights, for_run: str) -> HiddenWeights | None:
        """Train W_1..W_{L-1} with fixed K = `output.K`, starting from the hidden layers that K belongs to.

        M samples are drawn from the buffer, and `steps` Adam steps are taken on all of them, in float32. Adam starts
        anew each time. For noisy labels the loss weights states by the inverse variance, and a quarter of the samples
        is held out: the step that predicts them best is the result, and the old layers are kept if the gain is within
        the noise.

        Args:
            output: K_{T_k}, (1 + n_L, d), and the hash of the hidden layers it was adapted to.
            for_run: the controller run of `output`.

        Returns:
            The new hidden layers, or None if the old ones are kept; `counters["kept_<reason>"]` has the reason.
        """
        draw = self.begin(output, for_run)
        if draw is None:
            return None
        return self.finish(draw, descend(draw.problem, self.config.steps, self.config.learning_rate))

    def begin(self, output: OutputWeights, for_run: str) -> Draw | None:
        """Begin a training, up to the Adam steps; None if the old hidden layers are kept.

        The problem contains this trainer's network, so only one training can be open at a time.
        """
        self._waited, self._fresh = self._fresh, 0
        self.counters["trainings"] += 1
        K = output.K.numpy()
        if (why := self._unusable(K, output.hidden_sha256)) is not None:
            self.counters[counter_name("kept", why)] += 1
            return None
        xu, h = self.buffer.sample(self.config.batch, self._draws)
        self._network.load(self._bases[output.hidden_sha256])
        newest = self.buffer.last(for_run)
        if self._weights is None:
            return Draw(Problem(self._network, xu, h, K), output, for_run, newest)
        h, K = self._weighted(h, K)
        kept = len(xu) - max(1, round(HELD_OUT * len(xu)))
        held_out = xu[kept:], h[kept:]
        return Draw(Problem(self._network, xu[:kept], h[:kept], K, held_out), output, for_run, newest)

    def finish(self, draw: Draw, descent: Descent) -> HiddenWeights | None:
        """Finish a training: accept or reject the result of the Adam steps."""
        output, trained = draw.output, descent.hidden
        noisy = draw.problem.held_out is not None
        why = self._unwanted(descent, GAIN if noisy else 0.0)
        self.worth = Worth(descent.before - descent.after, why is None) if noisy else None
        if self.worth is not None:
            self._pace.trained(self._waited, descent.before, self.worth)
        if why is not None:
            self.counters[counter_name("kept", why)] += 1
            return None
        self._bases.move_to_end(output.hidden_sha256)
        self._take(trained)
        near = self.version < output.hidden_version + FARTHEST
        self.version = max(self.version, output.hidden_version) + (self._step if near else 1)
        self.counters["trained"] += 1
        return HiddenWeights(
            run_id=self.run_id,
            seq=self.version,
            for_run=draw.for_run,
            trained_on=output.seq,
            base_sha256=output.hidden_sha256,
            samples=len(draw.problem.window),
            loss_before=descent.before,
            loss_after=descent.after,
            network_sha256=self.description.sha256(),
            sha256=self.sha256,
            layers=[Array.of(layer, "<f4") for layer in trained],
            newest=draw.newest if noisy else UNSET,
        )

    def _unusable(self, K: np.ndarray, base_sha256: str) -> str | None:
        """Return why no training can begin with this K; None if one can."""
        if K.shape != (self.description.features, self.description.states):
            return "K has the wrong shape"
        if not np.isfinite(K).all():
            return "K is not finite"
        if np.abs(K).max() > np.finfo(np.float32).max:
            return "K is too large"
        if base_sha256 not in self._bases:
            return "K belongs to unknown hidden weights"
        return None if len(self.buffer) else "no samples"

    def _unwanted(self, descent: Descent, least: float) -> str | None:
        """Return why the old hidden layers are kept; None if the new ones reduce the loss by more than `least`."""
        if not all(np.isfinite(layer).all() for layer in descent.hidden):
            return "not finite"
        if why_unacceptable(self.description, descent.hidden) is not None:
            # The shapes are valid, because they are those of the trained network.
            return "norm bound"
        if not math.isfinite(descent.after):
            return "not finite"
        # A gain within the effect of noise would fit the noise.
        return None if descent.before - descent.after > least else "loss not lower"

    def _take(self, hidden: list[np.ndarray]) -> None:
        self.hidden = [np.array(layer, dtype=np.float32).astype(np.float64) for layer in hidden]
        """The newest hidden layers, float32 values in float64, (1 + n_{i-1}, n_i) each."""
        self.sha256 = hash_layers(self.hidden)
        """SHA-256 of `hidden`."""
        self._bases[self.sha256] = self.hidden
        self._bases.move_to_end(self.sha256)
        while len(self._bases) > BASES:
            self._bases.popitem(last=False)
