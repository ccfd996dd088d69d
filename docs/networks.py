"""Write two networks as examples of their format: `python docs/networks.py`.

`lk.onnx` is a flow by the method of Lucas and Kanade, `ramp.onnx` a depth prior that says that what
is lower in the image is nearer.
"""

import numpy as np
import onnx
from onnx import helper as h
from onnx import numpy_helper


def constant(name, values, kind=np.float32):
    """A named array of the network."""
    return numpy_helper.from_array(np.asarray(values, kind), name)


def value(name, channels):
    """An input or output (1, channels, H, W)."""
    return h.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, channels, "H", "W"])


def save(path, nodes, inputs, output, weights, **properties):
    """Check a network and write it."""
    graph = h.make_graph(nodes, "example", inputs, [output], weights)
    model = h.make_model(graph, opset_imports=[h.make_opsetid("", 13)], ir_version=8)
    h.set_model_props(model, properties)
    onnx.checker.check_model(model)
    onnx.save(model, path)


# --- flow: the normal equations of a window at every pixel ----------------------------------------

side = np.array([[-0.5, 0.0, 0.5]])
weights = [
    constant("grey", np.full((1, 3, 1, 1), 1 / 3)),
    constant("dx", side.reshape(1, 1, 1, 3)),
    constant("dy", side.reshape(1, 1, 3, 1)),
    constant("window", np.ones((1, 1, 15, 15))),
    constant("least", [1e-8]),
]
nodes = [
    h.make_node("Conv", ["ref", "grey"], ["a"]),
    h.make_node("Conv", ["next", "grey"], ["b"]),
    h.make_node("Conv", ["a", "dx"], ["x"], pads=[0, 1, 0, 1]),
    h.make_node("Conv", ["a", "dy"], ["y"], pads=[1, 0, 1, 0]),
    h.make_node("Sub", ["b", "a"], ["t"]),
]
for name in ("xx", "xy", "yy", "xt", "yt"):
    nodes.append(h.make_node("Mul", [name[0], name[1]], [f"own_{name}"]))
    nodes.append(h.make_node("Conv", [f"own_{name}", "window"], [name], pads=[7, 7, 7, 7]))
for product, factors in {"p": ("xx", "yy"), "q": ("xy", "xy")}.items():
    nodes.append(h.make_node("Mul", factors, [product]))
nodes += [h.make_node("Sub", ["p", "q"], ["d"]), h.make_node("Add", ["d", "least"], ["det"])]
for out, pairs in {
    "u": (("xy", "yt"), ("yy", "xt")),
    "v": (("xy", "xt"), ("xx", "yt")),
}.items():
    nodes += [h.make_node("Mul", pair, [f"{out}{k}"]) for k, pair in enumerate(pairs)]
    nodes.append(h.make_node("Sub", [f"{out}0", f"{out}1"], [f"{out}_top"]))
    nodes.append(h.make_node("Div", [f"{out}_top", "det"], [out]))
nodes.append(h.make_node("Concat", ["u", "v"], ["flow"], axis=1))
images = [value("ref", 3), value("next", 3)]
save("lk.onnx", nodes, images, value("flow", 2), weights, input_range="unit")

# --- depth prior: the number of the row -----------------------------------------------------------

weights = [
    constant("none", np.zeros((1, 3, 1, 1))),
    constant("one", [1.0]),
    constant("rows", 2, np.int64),
]
nodes = [
    h.make_node("Conv", ["image", "none"], ["zero"]),
    h.make_node("Add", ["zero", "one"], ["ones"]),
    h.make_node("CumSum", ["ones", "rows"], ["near"]),
]
save("ramp.onnx", nodes, [value("image", 3)], value("near", 1), weights)
