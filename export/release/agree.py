"""Measures how a network's outputs in bf16 and int8 agree with fp32 on labeled real scans; writes it into its cards.

`edgeperc.zoo.choose` reads this record: ``precision="auto"`` takes a reduced precision only if its loss is small.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime

from edgeperc.datasets.images import LabeledImages
from edgeperc.datasets.kitti import KittiLabels, KittiObjects, SemanticKitti
from edgeperc.datasets.layout import class_number
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.datasets.splits import names_of
from edgeperc.errors import ModelError, PointsError
from edgeperc.evaluation.camvid import check_classes, check_unseen_image
from edgeperc.evaluation.judge import Judge, Perceiving, check_unseen, training_scans_of
from edgeperc.evaluation.kitti_ap import FrontTruth, average_precisions, best_candidates, count_in_image, image_size_of
from edgeperc.evaluation.metrics import Confusion, Listed, mean
from edgeperc.evaluation.tables import Record, figures
from edgeperc.evaluation.truth import Truth
from edgeperc.inference.session import Session
from edgeperc.objects.candidate_boxes import LEAST_SCORE
from edgeperc.perceiver import Perceiver
from edgeperc.simulation.samples import IGNORE
from edgeperc.system.machine import cpu_features, cpu_model
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.perception import Box, Perception
from edgeperc.types.points import Bytes, Floats32
from edgeperc.types.sensor import SensorProfile
from edgeperc.zoo import BF16_FEATURES, Variant, resolve

from .object_parity import TOP_VIEW, candidate_inputs, objects_of
from .quantize import few
from .thinned import profile_of, thinned
from .to_onnx import write_card

NO_LABELS = KittiLabels((), np.empty((0, 14)))


@dataclass(frozen=True)
class Measured:
    """Labels and accuracy of one precision over all scans; ``by`` is the engine, provider and processor."""

    labels: list[Bytes]
    mean_iou: float
    ap: float | None
    by: str


def agree(
    models: Sequence[str | Path],
    *,
    kitti: Path | None,
    semantickitti: Path | None = None,
    camvid: Path | None = None,
    labeled: Sequence[ScanFolder] = (),
    split: str = "validation",
    n_scans: int | None = None,
) -> dict[str, dict[str, Any]]:
    """Measure every precision that the files of one network can run in on labeled scans or images, at most ``n_scans``
    of each set, and write the record into their cards; ``labeled``: sets of any sensor. Of networks for sparse sensors,
    KITTI's scans are thinned to a VLP-16's beams. Raises ModelError, PointsError, SplitError.
    """
    variants = {variant.precision: variant for model in models for variant in resolve(model)}
    names = {f"{variant.name} {variant.card.version}" for variant in variants.values()}
    if len(names) != 1 or "fp32" not in variants:
        raise ModelError(
            f"got {', '.join(map(str, variants.values()))} of {', '.join(sorted(names))}; "
            "expected files of one network, one of them in fp32"
        )
    fp32 = variants["fp32"]
    runs: dict[str, Variant] = {"fp32": fp32}
    kind, has_bf16 = fp32.card.view.kind, not BF16_FEATURES.isdisjoint(cpu_features())
    if kind == "pillars":
        raise ModelError(f"{fp32.name} is of pillars, whose precisions are not compared; ask for a precision by name")
    if kind != "objects" and importlib.util.find_spec("openvino") is not None and has_bf16:
        runs["bf16"] = fp32
    runs |= variants
    measure: Callable[..., Measured]
    if kind == "camera":
        if camvid is None:
            raise PointsError(f"{fp32.name} is of a camera, and there is no labeled image; name CamVid")
        measure = partial(_measure_images, data=LabeledImages(camvid))
    elif kind == "objects":
        if kitti is None:
            raise PointsError("objects are compared on KITTI's boxes; name a KITTI object set")
        measure = partial(_measure_objects, objects=KittiObjects(kitti))
    else:
        of_sets = {name for each in labeled for name in (*each.layout.boxes.values(), *each.layout.points.values())}
        shown = {class_number(name, fp32.card.classes) for name in of_sets}
        classes = [name for k, name in enumerate(fp32.card.classes) if k and k not in shown]
        if lacking := [name for name in classes if class_number(name) == IGNORE]:
            raise ModelError(
                f"{fp32.name} has classes that no labels of KITTI show: {', '.join(lacking)}. What they lose cannot be "
                "measured; name a set that labels them, --labeled FOLDER, or ask for the precision by name where its "
                "results are good enough"
            )
        measure = partial(_measure, kitti=kitti, semantickitti=semantickitti, labeled=labeled)
    measured = {precision: measure(variant, precision, split, n_scans) for precision, variant in runs.items()}
    options = [f"--kitti KITTI --split {split}"] * (kitti is not None)
    options += [f"--camvid CAMVID --split {split}"] * (camvid is not None)
    options += ["--semantickitti SEMANTICKITTI"] * (semantickitti is not None) + [f"--scans {n_scans}"] * bool(n_scans)
    options += [f"--labeled {each.layout.name.upper()}" for each in labeled]
    options += [f"--split {split}"] * (bool(labeled) and kitti is None)
    command = " ".join(["edgeperc-export agree", fp32.name, *options])
    records = {precision: record_of(each, measured["fp32"], command) for precision, each in measured.items()}
    for variant in variants.values():
        own = {precision: records[precision] for precision, each in runs.items() if each is variant}
        if "int8" in own and "quantized" in variant.card.training:
            own["int8"]["weight_bits"] = variant.card.training["quantized"]["weight_bits"]
        write_card(onnx.load(variant.path), replace(variant.card, precisions=own), variant.path)
    return records


def summary(precisions: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One line of text for each record of `agree`."""
    return [
        f"{precision}: labels agree on {record['label_agreement']:.3%}, mean IoU {100 * record['mean_iou']:.2f} "
        f"(fp32 {100 * record['fp32_mean_iou']:.2f})"
        + (f", AP {100 * record['ap']:.2f} (fp32 {100 * record['fp32_ap']:.2f})" if record["ap"] is not None else "")
        + f", loss {record['loss']:.2f} points, {record['n_scans']} scans"
        for precision, record in precisions.items()
    ]


def record_of(own: Measured, fp32: Measured, command: str) -> dict[str, Any]:
    """What the card says of a precision, compared with fp32."""
    same = sum(int(np.count_nonzero(a == b)) for a, b in zip(own.labels, fp32.labels, strict=True))
    losses = [fp32.mean_iou - own.mean_iou, 0.0]
    if own.ap is not None and fp32.ap is not None:
        losses.append(fp32.ap - own.ap)
    if not np.isfinite(losses).all():  # no loss would be seen
        raise PointsError(
            f"{len(own.labels)} labeled scans or images show no class of the network, so that no accuracy is measured; "
            "name a set with labels of its classes"
        )
    return {
        "n_scans": len(own.labels),
        "label_agreement": round(same / max(sum(labels.size for labels in own.labels), 1), 6),
        "mean_iou": round(own.mean_iou, 5),
        "fp32_mean_iou": round(fp32.mean_iou, 5),
        "ap": None if own.ap is None else round(own.ap, 5),
        "fp32_ap": None if fp32.ap is None else round(fp32.ap, 5),
        "loss": round(100.0 * max(losses), 3),
        "by": own.by,
        "command": command,
    }


def _measure(
    variant: Variant,
    precision: str,
    split: str,
    n_scans: int | None,
    *,
    kitti: Path | None,
    semantickitti: Path | None,
    labeled: Sequence[ScanFolder],
) -> Measured:
    sparse = profile_of("vlp-16") if variant.card.training.get("recipe", {}).get("sparse", False) else None
    sensors: list[SensorProfile | None] = [sparse, *(folder.layout.sensor for folder in labeled)]
    judges = [Judge([variant.path], Perceiving(boxes_from="network"), sensor=sensor) for sensor in sensors]
    by, *_ = (_engine(judge.perceive.sessions[0], precision) for judge in judges)  # one for all

    def answers() -> Iterator[tuple[str, Judge, Truth, Perception, Sequence[Box] | None]]:
        judge, *of_sets = judges
        if kitti is not None:
            objects = KittiObjects(kitti)
            for name in few(names_of(objects, split), n_scans):
                frame = objects.frame(name)
                check_unseen(judge.trained_on, name, frame.drive, frame.points)  # before it is thinned
                truth = judge.kitti(frame if sparse is None else thinned(frame, sparse))
                yield "real", judge, truth, judge.perceive(truth.points), None
        if semantickitti is not None and judge.from_above is not None:
            roads = SemanticKitti(semantickitti)
            for name in few(roads.names("all"), n_scans):
                truth = judge.semantickitti(roads.frame(name))
                yield "road", judge, truth, judge.perceive(truth.points), None
        for folder, judge in zip(labeled, of_sets, strict=True):
            for name in few(names_of(folder, split), n_scans):
                yield folder.layout.name, judge, *judge.perceive_frame(folder.frame(name))

    records: dict[str, list[Record]] = {}
    labels = []
    for block, judge, truth, found, boxes in answers():
        records.setdefault(block, []).append(judge.compare(truth, found, boxes)[0])
        labels.append(found.points.labels if found.points is not None else found.require_top_view().labels.ravel())
    if not labels:
        named = [str(root) for root in (kitti, semantickitti) if root is not None]
        where = f" in {' or '.join(named)}" if named else ": no data set was named"
        raise PointsError(
            f"no labeled scan of {split} drives{where}; name a KITTI object set (--kitti) or a labeled one (--labeled)"
        )
    blocks = [figures(of_block, 0) for of_block in records.values()]
    ious = [iou for block in blocks for iou in _ious(block)]
    aps = [block["boxes"]["oriented"]["all"]["vehicle"]["ap"] for block in blocks if "boxes" in block]
    known = [ap for ap in aps if ap is not None]
    return Measured(labels, mean(ious), mean(known) if known else None, by)


def _measure_objects(
    variant: Variant, precision: str, split: str, n_scans: int | None, *, objects: KittiObjects
) -> Measured:
    """Class of each cluster; overlap from above of each object with the best box; mean AP of cars (bird's eye and 3-D
    at 0.7, moderate), with the boxes of the top view as candidates, too.
    """
    perceive = Perceiver(
        [TOP_VIEW, variant.path],
        mounting=MODEL_MOUNTING,
        provider="cpu",
        agree=False,
        score_threshold=LEAST_SCORE,
        on_mismatch="ignore",
    )
    session = next(session for session in perceive.sessions if session.card.view.kind == "objects")
    trained_on = training_scans_of([session.card])
    labels, overlaps, table = [], [], Listed()
    for name in few(names_of(objects, split), n_scans):
        frame = objects.frame(name)
        check_unseen(trained_on, name, frame.drive, frame.points)
        truth = FrontTruth(frame.labels or NO_LABELS, frame.calibration, image_size_of(frame.drive))
        boxes = perceive(frame.points).boxes
        table += count_in_image(truth, boxes, frame.drive)
        overlaps += [each.iou for each in best_candidates(truth, boxes, frame.drive)]
        inputs, _, _ = candidate_inputs(session.card, frame.points)
        outputs = objects_of(session, inputs) if len(inputs) else inputs[:, 0]
        labels.append(outputs[:, : len(session.card.classes)].argmax(axis=1).astype(np.uint8))
    aps = [average_precisions(table["car", overlap, "moderate"])[2] for overlap in ("bird's eye 0.7", "3-D 0.7")]
    return Measured(labels, float(np.mean(overlaps)), float(np.mean(aps)), _engine(session, precision))


def _measure_images(
    variant: Variant, precision: str, split: str, n_images: int | None, *, data: LabeledImages
) -> Measured:
    check_classes(data, variant.card)
    perceive = Perceiver([variant.path])
    by = _engine(perceive.sessions[0], precision)
    trained_on = training_scans_of(perceive.cards)
    labels, confusion = [], Confusion(variant.card.classes)
    for file in few(data.files(split), n_images):
        image, truth = data.read(file)
        check_unseen_image(trained_on, image, file)
        found = perceive(image=image).require_image()
        labels.append(found.labels.ravel())
        confusion.update(found.labels, truth)
    return Measured(labels, confusion.mean_iou(), None, by)


def _ious(block: Mapping[str, Any]) -> list[float]:
    """IoU of every class of points without background, of vehicles as one class, and of road."""
    found = [row["iou"] for name, row in block.get("points", {}).get("all", {}).items() if name != "background"]
    for bands in block.get("segmentation", {}).values():
        found += [iou for name, iou in bands["all"]["iou"].items() if name in ("vehicle", "road")]
    return [np.nan if iou is None else iou for iou in found]


def _engine(session: Session, precision: str) -> str:
    """The engine, its version and the processor; for bf16 the session is made to compute through OpenVINO's own API."""
    if precision != "bf16":
        return f"onnxruntime {onnxruntime.__version__}, {session.provider}, {cpu_model()}"
    import openvino

    core = openvino.Core()
    settings = {"INFERENCE_PRECISION_HINT": "bf16", "PERFORMANCE_HINT": "LATENCY"}
    compiled = core.compile_model(core.read_model(session.path), "CPU", settings)
    active = compiled.get_property("INFERENCE_PRECISION_HINT")
    if active != openvino.Type.bf16:
        raise ModelError(f"OpenVINO runs {session.path} in {active}, not in bf16, on this processor")
    request = compiled.create_infer_request()
    request.set_input_tensor(openvino.Tensor(session.input[None], shared_memory=True))

    def run(n_rows: int = 1) -> Mapping[str, Floats32]:
        request.infer()
        for output in session.card.outputs:
            session.raw[output.kind][...] = request.get_tensor(output.name).data[0]
        session.spread()
        return session.outputs

    session.run = run  # type: ignore[method-assign]
    return f"OpenVINO {openvino.__version__.partition('-')[0]}, {cpu_model()}"
