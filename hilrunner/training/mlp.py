"""A multilayer perceptron as one flat vector of parameters: value and exact Jacobian of many points at once (torch)."""

from dataclasses import dataclass

import numpy as np
import torch


@dataclass(frozen=True)
class Shape:
    """Sizes of inputs, tanh layers and linear output."""

    sizes: tuple[int, ...]

    @property
    def parameter_count(self) -> int:
        """Weights and biases."""
        return sum((columns + 1) * rows for columns, rows in zip(self.sizes[:-1], self.sizes[1:], strict=True))

    def unpack(self, flat: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """(weight (rows, columns), bias (rows,)) of every layer: views into the flat vector."""
        layers, at = [], 0
        for columns, rows in zip(self.sizes[:-1], self.sizes[1:], strict=True):
            weight = flat[at : at + rows * columns].view(rows, columns)
            at += rows * columns
            layers.append((weight, flat[at : at + rows]))
            at += rows
        return layers

    def start(self, seed: int, device: str = "cpu") -> torch.Tensor:
        """Parameters to start from (Nguyen & Widrow 1990: the hidden units' slopes tile the range -1..1)."""
        random = np.random.default_rng(seed)
        parts = []
        last = len(self.sizes) - 2
        for index, (columns, rows) in enumerate(zip(self.sizes[:-1], self.sizes[1:], strict=True)):
            weight = random.uniform(-1.0, 1.0, (rows, columns))
            bias = random.uniform(-1.0, 1.0, rows)
            if index < last:
                size = 0.7 * rows ** (1.0 / columns)
                weight *= size / np.linalg.norm(weight, axis=1, keepdims=True)
                bias = size * np.linspace(-1.0, 1.0, rows) * np.sign(weight[:, 0])
            else:
                weight *= np.sqrt(1.0 / columns)
            parts += [weight.ravel(), bias]
        return torch.tensor(np.concatenate(parts), dtype=torch.float64, device=device)

    def values(self, flat: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Outputs (n, o) of inputs (n, i)."""
        layers = self.unpack(flat)
        for weight, bias in layers[:-1]:
            x = torch.tanh(torch.addmm(bias, x, weight.T))
        weight, bias = layers[-1]
        return torch.addmm(bias, x, weight.T)

    def values_and_jacobian(self, flat: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Outputs (n, o) and their derivatives over the parameters (o, n, p): exact, by back-propagation a output."""
        layers = self.unpack(flat)
        held = [x]
        for weight, bias in layers[:-1]:
            held.append(torch.tanh(torch.addmm(bias, held[-1], weight.T)))
        weight, bias = layers[-1]
        outputs = torch.addmm(bias, held[-1], weight.T)
        rows, count = len(x), outputs.shape[1]
        jacobian = torch.zeros((count, rows, self.parameter_count), dtype=x.dtype, device=x.device)
        starts = np.cumsum([0] + [(c + 1) * r for c, r in zip(self.sizes[:-1], self.sizes[1:], strict=True)])
        for output in range(count):
            at, columns = int(starts[-2]), self.sizes[-2]
            jacobian[output, :, at + output * columns : at + (output + 1) * columns] = held[-1]
            jacobian[output, :, at + count * columns + output] = 1.0
            sensitivity = weight[output].expand(rows, columns)
            for layer in range(len(layers) - 2, -1, -1):
                delta = sensitivity * (1.0 - held[layer + 1] ** 2)
                at, size = int(starts[layer]), self.sizes[layer + 1] * self.sizes[layer]
                target = jacobian[output, :, at : at + size].view(rows, self.sizes[layer + 1], self.sizes[layer])
                torch.mul(delta[:, :, None], held[layer][:, None, :], out=target)
                jacobian[output, :, at + size : at + size + self.sizes[layer + 1]] = delta
                if layer:
                    sensitivity = delta @ layers[layer][0]
        return outputs, jacobian
