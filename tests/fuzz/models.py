"""Models and their cards, settings, sensor profiles, recorded boxes and checkpoints, all damaged or hostile."""

from __future__ import annotations

import importlib.util
import io
import json
import os
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
from tiny_model import field, integers, node, number, tensor

from edgeperc import Perceiver, SensorProfile
from edgeperc.inference.session import Session
from edgeperc.records import read_boxes
from edgeperc.system.machine import fingerprint, read_setting, write_settings
from edgeperc.types.card import ModelCard
from edgeperc.types.onnx_file import OPERATORS, WITH_KERNELS
from edgeperc.types.sensor import SENSORS, get_sensor
from edgeperc.zoo import digest, model_path, resolve

from .mutate import mutated_bytes, mutated_document, mutated_json, mutated_message, noise, parse
from .running import Case, check, one_of
from .scans import MadeUp, check_perception, perceiver_of
from .tiny import CARD, GRAPH, boxed_card, image_card, model

LIMIT_S, LIMIT_MB = 40.0, 2500.0  # a first run may take 30 s
POINTS = np.random.default_rng(5).uniform(-20.0, 20.0, (300, 4)).astype(np.float32)
POINTS[:, 3] %= 1.0

# Pieces of an ONNX graph that a stranger would try. Each is a field: number, wire type, content.
EXTERNAL = [field(1, b"location") + field(2, b"/etc/passwd"), field(2, b"/etc/passwd") + field(1, b"location"), b""]
BODY = node("Identity", "c", "d")
HOSTILE = [
    *(field(5, tensor("w", (2, 2, 1, 1), bytes(16), more=field(13, e) + number(14, 1))) for e in EXTERNAL),
    *(field(5, tensor("w", (2, 2, 1, 1), bytes(16), more=field(13, e))) for e in EXTERNAL),
    *(field(5, tensor("w", dims, bytes(16))) for dims in [(1 << 40,), (-1, 2), (0,), (1 << 31, 1 << 31, 1 << 31), ()]),
    *(node(op, "x", "y", field(5, field(1, b"body") + field(6, BODY))) for op in ("Loop", "If", "Scan", "Conv")),
    *(node(op, "x w", "y") for op in sorted(OPERATORS)),
    *(node(op, "x w", "y", integers("kernel_shape", *[1] * n)) for op in sorted(WITH_KERNELS) for n in range(4)),
    *(node(op, "w w", "y") for op in sorted(OPERATORS)[::5]),
    *(node(op, "x w", "y") for op in ("Loop", "NonZero", "RandomUniform", "StringNormalizer", "Optional", "Range")),
    node("ConstantOfShape", "w", "w"), node("Tile", "x w", "y"), node("Conv", "y w", "y"), node("Add", "x x", "w"),
    node("Resize", "x", "y"), node("Conv", "x w", "y", field(7, b"com.microsoft")),
    field(15, field(1, tensor("v", (1,), bytes(4)))),
]  # fmt: skip
TOP_LEVEL = [
    field(25, field(1, b"Conv") + field(7, BODY)), field(20, field(1, BODY)), field(7, BODY), field(8, number(2, 1)),
    field(8, field(1, b"com.microsoft") + number(2, 1)), number(1, 1 << 62), field(14, b""), field(7, b""),
]  # fmt: skip
PIECES = [message[0] for message in map(parse, [*HOSTILE, *TOP_LEVEL]) if message]

OPTIONS: dict[str, Any] = {"provider": "cpu", "n_threads": 1}


class Models:
    """The kind ``models``."""

    name, limit_s, limit_mb = "models", LIMIT_S, LIMIT_MB

    def __init__(self) -> None:
        Perceiver("ssadnet", provider="cpu", n_threads=1)  # compiles the kernels, which no case should count
        self.tiny = model(GRAPH)
        self.fields = parse(self.tiny) or []
        self.graph = parse(GRAPH) or []
        self.shipped = model_path("lodnn:int8").read_bytes()
        self.cards = [CARD, boxed_card(), image_card()]
        self.documents = [json.loads(card.to_json()) for card in self.cards]
        self.documents += [json.loads(v.card.to_json()) for name in ("lodnn", "pointseg") for v in resolve(name)]
        self.digest = digest(resolve("lodnn"))
        self.profile = json.loads(SENSORS["vlp-16"].to_json())
        self.checkpoint: dict[str, Any] | None = None
        ways: list[tuple[int, Callable[[Case], str]]] = [
            (20, self.graph_bytes), (25, self.graph_message), (15, self.card_in_model), (15, self.card_made_up),
            (7, self.card_bytes), (4, self.shipped_model), (3, self.settings), (6, self.sensor), (3, self.boxes),
            (1, self.files),
        ]  # fmt: skip
        if importlib.util.find_spec("torch") and importlib.util.find_spec("onnx"):
            ways.append((1, self.torch_checkpoint))
        self.ways = [way for weight, way in ways for _ in range(weight)]

    def run(self, case: Case) -> str:
        return one_of(self.ways, case)

    def opened(self, case: Case, blob: bytes) -> str:
        """Open a model file, run it, perceive with it."""
        path = case.folder / "model.onnx"
        path.write_bytes(blob)
        if len(blob) < 1 << 20:
            case.evidence["model.onnx"] = blob
        session = Session(path, "cpu", n_threads=1)
        session.run()
        perceive = Perceiver(path, on_mismatch=case.pick(["ignore", "warn", "raise", "refuse"]), **OPTIONS)
        check_perception(perceive(POINTS), POINTS)
        return "answer"

    def graph_bytes(self, case: Case) -> str:
        if case.chance(0.5):
            return self.opened(case, mutated_bytes(self.tiny, case, 4))
        return self.opened(case, model(mutated_bytes(GRAPH, case, 4)))

    def graph_message(self, case: Case) -> str:
        if case.chance(0.3):
            return self.opened(case, mutated_message(self.fields, case, PIECES))
        return self.opened(case, model(mutated_message(self.graph, case, PIECES)))

    def shipped_model(self, case: Case) -> str:
        return self.opened(case, mutated_bytes(self.shipped, case, 3, near=case.pick([0, 3000])))

    def card_in_model(self, case: Case) -> str:
        return self.opened(case, model(GRAPH, card=mutated_json(self.documents[0], case)))

    def card_bytes(self, case: Case) -> str:
        text = self.cards[0].to_json().encode()
        return self.opened(case, model(GRAPH, card=mutated_bytes(text, case, 3)))

    def card_made_up(self, case: Case) -> str:
        """A card whose view may differ, with outputs as it says."""
        text = json.dumps(mutated_document(case.pick(self.documents), case)).encode()
        case.evidence["card.json"] = text
        card = ModelCard.from_json(text.decode())
        check(ModelCard.from_json(card.to_json()) == card, "a card read back differs")
        if card.view.height * card.view.width * (len(card.classes) + len(card.input.channels)) > 3_000_000:
            return "too large for a quick case"
        made_up = MadeUp(card)
        made_up.case = case
        options: dict[str, Any] = {
            "on_mismatch": case.pick(["ignore", "warn", "raise", "refuse"]),
            "sensor": case.pick([*SENSORS]),
            "full_turn": case.chance(0.2),
        }
        check_perception(perceiver_of(made_up, **options)(POINTS), POINTS)
        return "answer"

    def settings(self, case: Case) -> str:
        path = case.folder / "settings.json"
        entry = {"provider": "cpu", "precision": "fp32", "n_threads": 1, "ms": 1.5}
        document = {"schema": 2, "machines": {fingerprint(): {self.digest: entry}}}
        text = mutated_json(document, case)
        path.write_bytes(text)
        case.evidence["settings.json"] = text
        if case.chance(0.3):
            with mock.patch.dict(os.environ, {"EDGEPERC_CACHE_DIR": str(case.folder)}):
                Session("lodnn", "auto", n_threads=1)
            return "answer"
        if case.chance(0.3):
            write_settings(path, fingerprint(), {self.digest: entry})
        read_setting(path, fingerprint(), self.digest)
        return "answer"

    def sensor(self, case: Case) -> str:
        path = case.folder / "sensor.json"
        text = mutated_json(self.profile, case)
        path.write_bytes(text)
        case.evidence["sensor.json"] = text
        sensor = get_sensor(path)
        check(SensorProfile.from_json(sensor.to_json()) == sensor, "a profile read back differs")
        made_up = MadeUp(image_card())
        made_up.case = case
        perceive = perceiver_of(made_up, sensor=sensor, on_mismatch=case.pick(["ignore", "warn", "refuse"]))
        check_perception(perceive(POINTS), POINTS)
        return "answer"

    def boxes(self, case: Case) -> str:
        box = {"label": "car", "score": 0.5, "center": [1.0, 2.0, 3.0], "size": [4.0, 2.0, 1.5], "yaw": 0.1}
        lines = [mutated_json({"boxes": [box]}, case) for _ in range(int(case.rng.integers(1, 4)))]
        path = case.folder / "boxes.jsonl"
        path.write_bytes(b"\n".join(lines))
        case.evidence["boxes.jsonl"] = b"\n".join(lines)
        read_boxes(path)
        return "answer"

    def files(self, case: Case) -> str:
        """What stands where a model is expected."""
        path = case.folder / "model.onnx"
        way = int(case.rng.integers(7))
        if way == 0:
            os.mkfifo(path)
        elif way == 1:
            path.symlink_to(case.pick(["/dev/zero", "/dev/null", "/dev/full", "/proc/self/mem", "/proc/kmsg"]))
        elif way == 2:
            path.mkdir()
        elif way == 3:
            path.symlink_to(path)
        elif way == 4:
            path.write_bytes(noise(case))
        elif way == 5:
            path.write_bytes(b"")
        else:
            with path.open("wb") as file:
                file.truncate(int(case.pick([10**9, 3 * 10**9])))
        Session(path, "cpu")
        return "answer"

    def torch_checkpoint(self, case: Case) -> str:
        import torch

        from edgeperc_export.recipe import Recipe
        from edgeperc_export.release.to_onnx import load

        if self.checkpoint is None:
            self.checkpoint = checkpoint_of(Recipe("lodnn"))
        state = dict(self.checkpoint)
        if case.chance(0.6):
            key = case.pick([*state])
            values: list[Any] = [None, 1, "x", "[]", "{}", '{"network": []}', torch.zeros(3), {}, [1], float("nan")]
            state[key] = case.pick(values)
            if case.chance(0.3):
                del state[key]
        buffer = io.BytesIO()
        torch.save(state, buffer)
        blob = buffer.getvalue()
        if case.chance(0.6):
            blob = mutated_bytes(blob, case, 4, near=case.pick([0, 4000]))
        if case.chance(0.1):
            import pickle

            blob = pickle.dumps({"recipe": os.system})
        path = case.folder / "checkpoint.pt"
        path.write_bytes(blob)
        load(path)
        return "answer"


def checkpoint_of(recipe: Any) -> dict[str, Any]:
    """What a training writes."""
    from edgeperc_export.networks import build

    texts = {"recipe": json.dumps(vars(recipe), default=str), "frames": "{}", "before": "[]", "curve": "[]"}
    return {**texts, "n_simulated": 1, "step": 1, "best": None, "averaged": build(recipe).state_dict()}


def make(seed: int) -> Models:
    return Models()
