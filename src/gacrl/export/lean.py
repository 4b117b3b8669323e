"""An ONNX graph with fewer and quicker operators, of the same numbers to rounding.

A small network costs what its operators cost to call. onnxruntime folds what is constant; it leaves what is here:
jax2onnx writes products of stacks as Einsum, ReLUs as Max or Where, biases as Add.
"""

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

Node = Any
"""An `onnx.NodeProto`."""
_STACKS = ("abc,cd->abd", "abcd,de->abce")
"""Products of a stack of rows with a matrix."""


def lean(data: bytes) -> bytes:
    """Return the model, with operators of ONNX alone."""
    import onnx  # pyright: ignore[reportMissingImports]

    model = onnx.load_from_string(_folded(data))
    for rewritten in (_products, _relus, _leaky_relus, _biases, _concatenations):
        nodes = list(rewritten(_Graph(model.graph)))
        del model.graph.node[:]
        model.graph.node.extend(nodes)
    named = [opset for opset in model.opset_import if opset.domain]  # onnxruntime's own, of which no node is
    for opset in named:
        model.opset_import.remove(opset)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _folded(data: bytes) -> bytes:
    """What onnxruntime makes of it without operators of its own: shapes and constants are known."""
    import onnxruntime  # pyright: ignore[reportMissingImports]

    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.log_severity_level = 4  # it warns that the file fits one machine, which is so beyond this level
    with tempfile.TemporaryDirectory() as folder:
        options.optimized_model_filepath = str(Path(folder) / "folded.onnx")
        onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        return Path(options.optimized_model_filepath).read_bytes()


class _Graph:
    """A graph, and who makes and takes its arrays."""

    def __init__(self, graph: Any):
        from onnx import helper, numpy_helper  # pyright: ignore[reportMissingImports]

        self.nodes: list[Node] = list(graph.node)
        self.node: Callable[..., Node] = helper.make_node
        self.known = {array.name: numpy_helper.to_array(array) for array in graph.initializer}
        self.made_by = {name: node for node in self.nodes for name in node.output}
        self.uses = Counter(name for node in self.nodes for name in node.input)
        self.uses.update(output.name for output in graph.output)
        self._initializers, self._written = graph.initializer, numpy_helper.from_array

    def constant(self, name: str, value: Any) -> str:
        """Have this array in the graph, by that name."""
        if name not in self.known:
            self.known[name] = np.asarray(value)
            self._initializers.append(self._written(self.known[name], name))
        return name

    def number(self, name: str) -> float | None:
        """Return the single number that a constant is; None for anything else."""
        array = self.known.get(name)
        return None if array is None or array.size != 1 else float(array.reshape(()))

    def alone(self, name: str, kind: str) -> Node | None:
        """Return who makes this array, where that is of this kind and nobody else takes it."""
        node = self.made_by.get(name)
        return node if node is not None and node.op_type == kind and self.uses[name] == 1 else None

    def without(self, nodes: list[Node], gone: list[Node]) -> Iterator[Node]:
        """Leave out nodes that nobody needs any more."""
        names = {name for node in gone for name in node.output}
        return (node for node in nodes if not names.intersection(node.output))


def _attribute(node: Node, name: str) -> Any:
    from onnx import helper  # pyright: ignore[reportMissingImports]

    return next((helper.get_attribute_value(it) for it in node.attribute if it.name == name), None)


def _products(graph: _Graph) -> Iterator[Node]:
    """Einsum as MatMul, which is quicker."""
    for node in graph.nodes:
        equation = (_attribute(node, "equation") or b"").decode() if node.op_type == "Einsum" else ""
        axis = {"za,zab->zb": 1, "za,zba->zb": 2}.get(equation)
        if equation in _STACKS:
            yield graph.node("MatMul", list(node.input), list(node.output))
        elif axis is not None:
            rows, stack = node.input
            row, product, result = f"{node.output[0]}_row", f"{node.output[0]}_product", node.output[0]
            axes = graph.constant(f"lean_axis_{axis}", np.array([axis], np.int64))
            yield graph.node("Unsqueeze", [rows, axes], [row])
            yield graph.node("MatMul", [row, stack] if axis == 1 else [stack, row], [product])
            yield graph.node("Squeeze", [product, axes], [result])
        else:
            yield node


def _relus(graph: _Graph) -> Iterator[Node]:
    """Max(x, 0) as Relu, which is fused with what is before it."""
    for node in graph.nodes:
        others = [name for name in node.input if graph.number(name) != 0.0]
        if node.op_type == "Max" and len(node.input) == 2 and len(others) == 1:
            yield graph.node("Relu", others, list(node.output))
        else:
            yield node


def _leaky_relus(graph: _Graph) -> Iterator[Node]:
    """Where(x >= 0, x, slope · x) as LeakyRelu."""
    nodes, gone = list[Node](), list[Node]()
    for node in graph.nodes:
        asked = graph.alone(node.input[0], "GreaterOrEqual") if node.op_type == "Where" else None
        times = None if asked is None else graph.alone(node.input[2], "Mul")
        if asked is not None and times is not None:
            x = node.input[1]
            slopes = [slope for name in times.input if name != x and (slope := graph.number(name)) is not None]
            if asked.input[0] == x and graph.number(asked.input[1]) == 0.0 and x in times.input and slopes:
                gone += [asked, times]
                node = graph.node("LeakyRelu", [x], list(node.output), alpha=slopes[0])
        nodes.append(node)
    return graph.without(nodes, gone)


def _biases(graph: _Graph) -> Iterator[Node]:
    """Gemm(a, b) + c as Gemm(a, b, c)."""
    nodes, gone = list[Node](), list[Node]()
    for node in graph.nodes:
        added = list(node.input) if node.op_type == "Add" else []
        bias = [name for name in added if name in graph.known]
        products = [product for name in added if (product := graph.alone(name, "Gemm")) is not None]
        if bias and products and all(graph.number(name) == 0.0 for name in products[0].input[2:]):
            gone += products
            named = {name: _attribute(products[0], name) or 0 for name in ("transA", "transB")}
            node = graph.node("Gemm", [*products[0].input[:2], *bias], list(node.output), **named)
        nodes.append(node)
    return graph.without(nodes, gone)


def _concatenations(graph: _Graph) -> Iterator[Node]:
    """Concat of Concats along the same axis as one."""
    nodes, gone = list[Node](), list[Node]()
    parts: dict[str, list[str]] = {}
    for node in graph.nodes:
        if node.op_type == "Concat":
            axis, names = _attribute(node, "axis"), list[str]()
            for name in node.input:
                before = graph.alone(name, "Concat")
                if before is not None and _attribute(before, "axis") == axis:
                    names += parts[name]
                    gone.append(before)
                else:
                    names.append(name)
            parts[node.output[0]] = names
            node = graph.node("Concat", names, list(node.output), axis=axis)
        nodes.append(node)
    return graph.without(nodes, gone)
