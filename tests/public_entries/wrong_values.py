"""Values that an argument of some kind must refuse, and values that nobody expects anywhere."""

import numpy as np
import torch
from tensordict import TensorDict

nan, inf = float("nan"), float("inf")
NO_NUMBERS = ["a", None, object(), {}, [1.0, "a"], 1j]
OTHER = torch.zeros(2, 3)
STILL = {"qpos": torch.zeros(1, 2), "qvel": torch.zeros(1, 2)}
NO_OBJECTS = [None, "a", 3, nan, [], {}, object(), torch.zeros(2)]
BROKEN = [torch.full((2, 1), nan), torch.tensor([[0.5], [inf]])]

WRONG = {
    "count": [0, -1, 2.5, nan, inf, "a", None, [3], torch.zeros(3), 1j],
    "count or none": [0, -1, 2.5, nan, "a", [3], torch.zeros(3), 1j],
    "count or zero": [-1, 2.5, nan, "a", None, [3], torch.zeros(3)],
    "rate": [0.0, -1.0, nan, inf, *NO_NUMBERS, torch.zeros(3)],
    "share": [-0.1, 1.1, nan, *NO_NUMBERS, torch.zeros(3)],
    "object": NO_OBJECTS,
    "object or none": [value for value in NO_OBJECTS if value is not None],
    "pairs": [
        *NO_OBJECTS,
        TensorDict({}, [0]),
        TensorDict({"theta": torch.ones(8, 1)}, [8]),
        TensorDict({"theta": torch.ones(8, 2), "summary": torch.ones(8, 1)}, [8]),
        TensorDict({"theta": torch.ones(8, 1), "summary": torch.ones(8, 1, 2)}, [8]),
        TensorDict({"theta": torch.ones(8, 1), "summary": torch.full((8, 1), nan)}, [8]),
        TensorDict({"theta": torch.ones(8, 1), "summary": torch.ones(8, 1) * 1j}, [8]),
        TensorDict({"theta": torch.ones(8, 1) * 1j, "summary": torch.ones(8, 1)}, [8]),
        TensorDict({"theta": torch.full((8, 1), 9.0), "summary": torch.ones(8, 1)}, [8]),
        TensorDict({"theta": {"a": torch.ones(8, 1)}, "summary": torch.ones(8, 1)}, [8]),
        TensorDict({"theta": torch.ones(8, 1), "summary": torch.ones(8, 1)}, [8]).set(
            "weight", torch.ones(8, 3)
        ),
        TensorDict({"theta": torch.ones(8, 1), "summary": torch.ones(8, 1)}, [8]).set(
            "weight", torch.ones(8) * 1j
        ),
    ],
    "parameters": [*NO_NUMBERS, *BROKEN, torch.zeros(0, 1), torch.ones(1, 1) * 1j, OTHER],
    "hidden parameters": [*NO_NUMBERS, *BROKEN, torch.zeros(0), torch.ones(1) * 1j, OTHER],
    "rows of parameters": [*NO_NUMBERS, 3, OTHER, torch.zeros(())],
    "rows of theta": [*BROKEN],
    "summary": [*NO_NUMBERS, *BROKEN, OTHER, torch.zeros(0), torch.ones(1) * 1j],
    "summaries": [*NO_NUMBERS, 3, torch.zeros(12), torch.zeros(5, 1), torch.ones(12, 1) * 1j],
    "state": ["a", 3, None, [1], {"logits": torch.zeros(1)}],
    "units": [3, "a", ["a"], {"b": "m"}],
    "matrix": ["a", 3, object(), torch.zeros(1, 1), torch.full((1, 1), nan), torch.ones(1, 1) * 1j],
    "shape": [None, 3, "a", (-1,), (2.5,), ("a",)],
    "key": [3, None, "", (), ("a", 3), []],
    "string": [3, nan, None, [], object(), torch.zeros(2)],
    "strength": ["a", nan, None, object(), [1.0, 2.0], {"no such target": 1.0}],
    "components": [
        *NO_OBJECTS[:4], {"no such": torch.zeros(2, 2)}, {"qpos": torch.zeros(3, 2)},
        {"qpos": torch.full((2, 2), nan)}, {"qpos": "a"}, {"qpos": None},
    ],
    "mask or none": ["a", 3, torch.ones(2), torch.ones(3, dtype=torch.bool), object()],
    "segments": [
        *NO_OBJECTS[:4], {}, {"qpos": torch.zeros(1, 2)}, {**STILL, "action": torch.zeros(1, 2)},
        {**STILL, "action": torch.full((1, 2, 1), nan)}, {**STILL, "action": "a"},
        {**STILL, "action": torch.zeros(2, 2, 1)}, {**STILL, "action": torch.zeros(1, 0, 1)},
    ],
    "names of outputs": ["qpos", 3, None, [3], ("no such",)],
    "columns": [3, "a", None, [0.5], [99], ["a"]],
    "noise": [3, "a", None, {"no such": 1.0}, *({"hinge position": v} for v in (-1.0, nan, "a"))],
    "source of logs": [None, 3, nan, [], {}, "no such folder", [3], TensorDict({}, [8]), object()],
    "logs": [None, 3, "a", [], [3], (None,), object(), torch.zeros(2)],
    "path": ["no such file", ".", "a" * 5000],
    "names": [3, nan, [3], [None], {}, object()],
    "name": [3, nan, None, [], {}, object(), "no such name", "", torch.zeros(2)],
    "pairs of numbers": [
        None, "a", 3, {}, [], {"a": 1.0}, {"a": (2.0, 1.0, 3.0)}, {"a": (nan, 1.0)},
        {"a": (0.0, -1.0)}, {"a": ("x", "y")}, {3: (0.0, 1.0)}, {"a": (0.0, 1j)},
        [("a", (1.0, 2.0)), ("a", (1.0, 2.0))], {"a": None}, torch.zeros(2, 2),
    ],
    "deviations": [*NO_NUMBERS, -torch.ones(1), torch.zeros(1), torch.ones(3), torch.ones(1) * 1j],
    "bounds": [*NO_OBJECTS, (0.0, 1.0), (torch.ones(1), torch.ones(2)), (torch.ones(1),) * 2],
    "widths": [None, 3, "a", [None], ["a"], [0], [2.5], object()],
    "draw key": [None, 3, nan, object()],
    "distance or none": [-0.1, nan, inf, "a", object(), {}],
    "function": [None, "a", 3, [], torch.zeros(2)],
    "rows": [
        *NO_OBJECTS,
        TensorDict({}, [2, 3]),
        TensorDict({"observation": torch.full((2, 3, 4), nan)}, [2, 3]),
        TensorDict({"observation": torch.zeros(2, 3, 4), "mask": torch.ones(2, 3)}, [2, 3]),
    ],
}  # fmt: skip
WRONG["share below"] = [-0.1, nan, inf, *NO_NUMBERS]
for kind in ("rate", "parameters", "names", "function", "name"):
    WRONG[f"{kind} or none"] = [value for value in WRONG[kind] if value is not None]

ANYWHERE = [
    None, True, 0, -1, 3, 2.5, nan, inf, 1j, "", "a", b"a", [], [None], ["a"], (), (nan,), {},
    {"a": 1}, object(), int, lambda *_: None, np.float32(1.5), np.array("a"), np.zeros((2, 0)),
    torch.zeros(()), torch.zeros(3), torch.zeros(2, 3, 4), torch.full((2,), nan),
    torch.ones(2) * 1j, torch.ones(2, dtype=torch.int8), torch.tensor(True), TensorDict({}, []),
    TensorDict({"a": torch.zeros(2)}, [2]),
]  # fmt: skip
