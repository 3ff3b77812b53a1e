"""The learner of a student: his actions, his primitives and his gate come near the teacher's."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from service.actors.distillation import Lesson
from service.base.tensors import join_parts
from service.base.types import Array, Arrays, FloatArray, Metrics
from service.config.distillation import DistillationConfig
from service.policies import networks
from service.policies.adam import Adam, copied, put_back
from service.policies.forward import compose

_ADAM_EPSILON = 1e-8
_MAX_GRAD_NORM = 1.0
_GATE_WEIGHT = 0.1
"""Of the gate's error, beside those of actions and primitives."""
_LAST_RATE = 0.02
"""Share of the learning rate at the end."""


class Distiller:
    """Learns a student from lessons; the same lessons give the same student.

    Args:
        student: changed by learning.
        config: how to learn.
    """

    def __init__(self, student: networks.MCPPolicy, config: DistillationConfig) -> None:
        self.student, self.config = student, config
        self._parameters = dict(student.named_parameters())
        self._optimizer = Adam(self._parameters, config.learning_rate, epsilon=_ADAM_EPSILON)
        self._average = {name: parameter.detach().clone() for name, parameter in self._parameters.items()}

    def learn(self, lesson: Lesson, progress: float, rng: np.random.Generator) -> Metrics:
        """Take ``gradient_steps`` steps over random parts of a lesson.

        Args:
            lesson: of the newest student.
            progress: of the run, from 0 to 1.
            rng: draws the parts.

        Returns:
            Mean errors over the steps: squared, of the composed mean action (``action``), and of each primitive's mean
            and log-std (``primitives``), summed over the action's components; and of the gate's log weights (``gate``).
        """
        self._optimizer.learning_rate = self.config.learning_rate * (1.0 - (1.0 - _LAST_RATE) * min(1.0, progress))
        columns = [
            torch.from_numpy(each) for each in (lesson.observation, lesson.means, lesson.variances, lesson.weights)
        ]
        found = []
        for _ in range(self.config.gradient_steps):
            rows = torch.from_numpy(rng.integers(len(lesson.observation), size=self.config.batch_size))
            errors = self.errors(*(column[rows] for column in columns))
            loss = errors[0] + errors[1] + _GATE_WEIGHT * errors[2]
            self.student.zero_grad()
            loss.backward()
            clip_grad_norm_(list(self._parameters.values()), _MAX_GRAD_NORM)
            self._optimizer.step()
            found.append(torch.stack(errors).detach())
        with torch.no_grad():
            for name, parameter in self._parameters.items():
                self._average[name].lerp_(parameter, 1.0 - self.config.ema_decay)
        names = "action_error", "primitives_error", "gate_error"
        means = torch.stack(found).mean(0).tolist()
        return {**dict(zip(names, means, strict=True)), "learning_rate": self._optimizer.learning_rate}

    def errors(self, observation: Tensor, means: Tensor, variances: Tensor, weights: Tensor) -> list[Tensor]:
        """The three errors of ``learn`` at (B, O) observations."""
        own_means, own_variances = self.student.primitives(observation[:, : self.student.num_positions])
        own_weights = self.student.gate(observation)
        mean, _ = compose(weights, means, variances)
        own_mean, _ = compose(own_weights, own_means, own_variances)
        log_stds = 0.5 * (own_variances.log() - variances.log())
        return [
            (own_mean - mean).square().sum(-1).mean(),
            (own_means - means).square().sum(-1).mean() + log_stds.square().sum(-1).mean(),
            (own_weights.log() - weights.log()).square().mean(),
        ]

    def parameters(self) -> dict[str, FloatArray]:
        """The student as he acts."""
        return networks.export_parameters(self.student)

    def averaged_parameters(self) -> dict[str, FloatArray]:
        """The student as he is evaluated and published."""
        return self.parameters() | {name: tensor.numpy().copy() for name, tensor in self._average.items()}

    def begin(self) -> None:
        """Let the average begin where the student is."""
        for name, parameter in self._parameters.items():
            self._average[name].copy_(parameter.detach())

    def state(self) -> Arrays:
        """Everything that ``load_state`` continues from, copied."""
        return copied(self._tensors())

    def load_state(self, state: Mapping[str, Array]) -> None:
        """Continue, bit for bit, where ``state`` was taken."""
        put_back(state, self._tensors())

    def _tensors(self) -> dict[str, Tensor]:
        parts: dict[str, Mapping[str, Tensor]] = {"student": self._parameters, "average": self._average}
        parts["adam"] = self._optimizer.tensors()
        return join_parts(parts)
