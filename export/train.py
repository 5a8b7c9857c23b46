"""One visible training loop for every network.

Every step draws its samples and its dropout from ``(seed, step)`` alone, so that a run stopped anywhere and resumed
from its checkpoint ends, bit for bit, where an uninterrupted one ends.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from edgeperc.datasets import IGNORE, KittiObjects, scan_hash
from edgeperc.metrics import BoxEvaluator, Confusion
from edgeperc.perceiver import decode_top_view
from edgeperc.perception import Box
from edgeperc.projection import make_projector
from edgeperc.simulation import POINT_CLASSES, TOP_VIEW_CLASSES

from .augment import LabelledScan, ObjectBank, augmented, swapped
from .cards import LABELS_POINTS, RANGE_IMAGE, RANGE_IMAGE_INPUT, ROAD_CLASSES, TOP_VIEW, TOP_VIEW_INPUT, card_of
from .losses import (
    box_distillation_loss,
    dense_targets,
    distillation_loss,
    pointseg_loss,
    road_loss,
    slot_targets,
    ssadnet_loss,
)
from .networks.edge import PointSegEdge, SSADNetEdge
from .networks.kulseg import KULSeg
from .networks.lodnn import LoDNN, LoDNNEdge
from .networks.pointseg import PointSeg
from .networks.squeezesegv2 import SqueezeSegV2
from .networks.ssadnet import SSADNet
from .road import drawn_roads, sure_surface, with_road
from .selftraining import pseudo_labelled, taught, unlabelled_scans

# Three returns are the fewest that any network could tell from clutter.
FEWEST = 3
N_SLOTS = 16
# Vehicles are 4 % of the labelled pixels, pedestrians and cyclists 0.2 %.
POINT_WEIGHTS = (1.0, 2.0, 4.0, 4.0)
TOP_VIEW_WEIGHTS = (1.0, 1.0, 2.0, 4.0, 4.0)
# The dense head's loss is a sum a box, ten times the segmentation's per pixel.
LW_DET_DENSE = 0.2
WARM_UP_STEPS = 100
# Of neighbouring frames one in so many is enough to watch a run by.
VALIDATION_STRIDE = 6
# Scans whose objects are cut out for pasting; each holds about five.
BANK_SCANS = 400
PASTE_ODDS = {
    "points": {"pedestrian": 0.4, "cyclist": 0.35, "van": 0.15, "truck": 0.1},
    "top_view": {"car": 0.3, "van": 0.4, "truck": 0.3},
}


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a training run, but the scans.

    Attributes
    ----------
    network : str
        ``"ssadnet"`` or ``"lodnn"``, which see the top view, or ``"pointseg"``, ``"squeezesegv2"`` or ``"kulseg"``,
        which label points.
    head : str
        SSADNet's boxes: ``"slots"`` (the paper's) or ``"dense"``.
    steps, batch : int
    optimizer : str
        ``"adamw"``, ``"adam"`` or ``"adagrad"``.
    learning_rate, weight_decay : float
        Warmed up over 100 steps, then constant, then a cosine to zero.
    cooldown : float
        Share of the steps that the cosine takes. Until it begins, a longer run is the same run.
    halve_after : int
        Epochs without a lower validation loss after which the learning rate is halved (SSADNet 3.2); 0: never.
    simulated_share : float
        Part of the samples that are simulated; what is left is real.
    augment : bool
        Turn, mirror, thin and shift every scan.
    n_pasted : float
        Objects cut from other scans that are pasted into one, on average.
    swap : float
        Share of scans one sector of which comes from another scan; point labels only.
    paste_cars : float
        Share of cars among what a network that labels points has pasted.
    turn_to_rare : float
        Share of simulated scans turned to a pedestrian or cyclist.
    turn_anywhere : float
        Share of simulated scans turned to any side, so that vehicles stand where streets have none.
    weather : float
        Share of scans in rain, snow or fog.
    class_weights : bool
        Weigh classes in the cross-entropy by how rare they are.
    focal_gamma : float
        Of the cross-entropy of networks that label points.
    lovasz_weight : float
        Of the Lovasz-softmax loss beside the cross-entropy.
    deep_supervision : float
        Weight of PointSeg's loss at a quarter of the width.
    ema : float
        Decay of the averaged weights, which are what is exported; 0: the last weights.
    context_width : int
        Channels of SSADNet's and LoDNN's context module.
    batch_norm : bool
        In SSADNet's segmentation branch and in LoDNN.
    dropout : float
        SSADNet's and LoDNN's spatial dropout; before the last convolution of networks that label points.
    distil : float
        Weight of what a teacher's answers are learnt with: cross-entropy towards its class probabilities (Hinton et
        al., 2015), and its dense boxes.
    seen_twice : bool
        Show each scan to the teacher as it is and mirrored, and average; twice the teacher's time.
    edge : bool
        The network of the same inputs and outputs for small computers (`edgeperc_export.networks.edge`).
    head_only : bool
        Leave SSADNet's segmentation branch as it was started from; only the boxes are learnt.
    drawn_roads : bool
        Where a road was drawn by hand (`edgeperc_export.road.drawn_roads`), that is the truth of the scan's surface.
    seed : int
    """

    network: str
    head: str = "dense"
    steps: int = 2000
    batch: int = 8
    optimizer: str = "adamw"
    learning_rate: float = 2e-3
    weight_decay: float = 1e-3
    cooldown: float = 0.4
    halve_after: int = 0
    simulated_share: float = 0.5
    augment: bool = True
    n_pasted: float = 6.0
    swap: float = 0.3
    paste_cars: float = 0.0
    turn_to_rare: float = 0.3
    turn_anywhere: float = 0.0
    weather: float = 0.1
    class_weights: bool = True
    focal_gamma: float = 0.0
    lovasz_weight: float = 1.0
    deep_supervision: float = 0.0
    ema: float = 0.998
    context_width: int = 128
    batch_norm: bool = True
    dropout: float = 0.25
    distil: float = 0.0
    seen_twice: bool = True
    edge: bool = False
    head_only: bool = False
    drawn_roads: bool = False
    seed: int = 0

    @property
    def labels_points(self) -> bool:
        """Whether the network sees the range image and labels points."""
        return self.network in LABELS_POINTS


EDGE: dict[str, type[nn.Module]] = {"lodnn": LoDNNEdge, "pointseg": PointSegEdge, "ssadnet": SSADNetEdge}
PLAIN = {
    "simulated_share": 0.0,
    "augment": False,
    "n_pasted": 0.0,
    "swap": 0.0,
    "turn_to_rare": 0.0,
    "weather": 0.0,
    "class_weights": False,
    "lovasz_weight": 0.0,
    "weight_decay": 0.0,
    "cooldown": 0.0,
    "ema": 0.0,
    "batch_norm": False,
}
PAPER = {
    # SSADNet 3.2: Adam, 1e-5, halved after 100 epochs without gain; batch 8; cross-entropy and 0.1 x MSE.
    "ssadnet": Recipe(
        "ssadnet", head="slots", optimizer="adam", learning_rate=1e-5, halve_after=100, steps=65_000, **PLAIN
    ),
    # PointSeg 5: Adagrad, 1e-3, batch 32, 50,000 steps.
    "pointseg": Recipe("pointseg", optimizer="adagrad", learning_rate=1e-3, batch=32, steps=50_000, **PLAIN),
    # LoDNN-I (Electronics 12, 3165) 3.3 to 3.6: cross-entropy on drawn roads, augmented; 22 epochs; the rate is lowered
    # when a watched figure stands still. Its rate is printed as "1 x 10^-x" and its batch as the largest tried: Adam's
    # usual rate, and 16. 22 epochs of 300 scenes eight times over are 3,300 steps of 16. It drew 300 scenes; here are
    # nine, and what is sure of the other real scans.
    "lodnn": Recipe(
        "lodnn",
        optimizer="adam",
        learning_rate=1e-3,
        halve_after=1,
        batch=16,
        steps=3_300,
        drawn_roads=True,
        **PLAIN | {"augment": True},
    ),
}
"""What the papers say of their training; what they do not mention is left out."""


def build(recipe: Recipe) -> nn.Module:
    """The network of a recipe, its weights drawn from the recipe's seed."""
    torch.manual_seed(recipe.seed)
    if recipe.edge:
        if recipe.network not in EDGE:
            raise ValueError(f"{recipe.network} has no network for small computers; expected {' or '.join(EDGE)}")
        return EDGE[recipe.network]()
    if recipe.network == "pointseg":
        return PointSeg(dropout=recipe.dropout, deep_supervision=recipe.deep_supervision > 0.0)
    if recipe.network == "squeezesegv2":
        return SqueezeSegV2(dropout=recipe.dropout)
    if recipe.network == "kulseg":
        return KULSeg(dropout=recipe.dropout)
    if recipe.network == "lodnn":
        return LoDNN(context_width=recipe.context_width, batch_norm=recipe.batch_norm, dropout=recipe.dropout)
    if recipe.network == "ssadnet":
        width, norm = recipe.context_width, recipe.batch_norm
        return SSADNet(head=recipe.head, context_width=width, batch_norm=norm, dropout=recipe.dropout)
    raise ValueError(f"network is {recipe.network!r}; expected ssadnet, lodnn, pointseg, squeezesegv2 or kulseg")


class Samples:
    """Real and simulated scans as network inputs and targets.

    Parameters
    ----------
    recipe : Recipe
    real : sequence of LabelledScan
    real_weights : sequence of float
        How often each real scan is drawn; frames of a long drive look alike and deserve less.
    simulated : sequence of Path
        Files that `LabelledScan.save` wrote.
    """

    def __init__(
        self, recipe: Recipe, real: Sequence[LabelledScan], real_weights: Sequence[float], simulated: Sequence[Path]
    ) -> None:
        if not real and not simulated:
            raise ValueError("no scans to train on; give --kitti, --simulated or both")
        self.recipe, self.real, self.simulated = recipe, real, simulated
        view = (RANGE_IMAGE, RANGE_IMAGE_INPUT) if recipe.labels_points else (TOP_VIEW, TOP_VIEW_INPUT)
        self.projector = make_projector(*view)
        weights = np.asarray(real_weights, np.float64)
        self.real_odds = weights / weights.sum() if len(weights) else weights
        share = recipe.simulated_share if real else 1.0
        self.simulated_share = share if simulated else 0.0
        self.bank: ObjectBank | None = None
        if recipe.n_pasted > 0.0:
            every = max(1, len(simulated) // BANK_SCANS)
            self.bank = ObjectBank.of([*real, *(LabelledScan.load(path) for path in simulated[::every])])

    def batch(self, step: int) -> tuple[NDArray, ...]:
        """Inputs (B, C, H, W) and targets of one step; the same for the same step, always."""
        rng = np.random.default_rng((self.recipe.seed, step))
        drawn = [self.sample(self._drawn(rng)) for _ in range(self.recipe.batch)]
        return tuple(np.stack(parts) for parts in zip(*drawn, strict=True))

    def _drawn(self, rng: np.random.Generator) -> LabelledScan:
        recipe = self.recipe
        scan = self._scan(rng)
        if not recipe.augment:
            return scan
        odds = PASTE_ODDS["points" if recipe.labels_points else "top_view"]
        if recipe.paste_cars > 0.0:
            others = {name: share * (1.0 - recipe.paste_cars) for name, share in odds.items()}
            odds = {**others, "car": recipe.paste_cars}
        changes = {
            "bank": self.bank,
            "n_pasted": recipe.n_pasted,
            "odds": odds,
            "turn_to_rare": recipe.turn_to_rare,
            "turn_anywhere": recipe.turn_anywhere,
            "weather": recipe.weather,
        }
        scan = augmented(scan, rng, **changes)
        if recipe.labels_points and rng.random() < recipe.swap:
            scan = swapped(scan, augmented(self._scan(rng), rng, **changes), rng)
        return scan

    def _scan(self, rng: np.random.Generator) -> LabelledScan:
        if rng.random() < self.simulated_share:
            return LabelledScan.load(self.simulated[rng.integers(len(self.simulated))])
        return self.real[rng.choice(len(self.real), p=self.real_odds)]

    def sample(self, scan: LabelledScan) -> tuple[NDArray, ...]:
        """One input (C, H, W) and its targets."""
        points = np.ascontiguousarray(scan.points, np.float32)
        if self.recipe.labels_points:
            seen = self.projector.project(points)
            truth = np.append(scan.labels, np.uint8(IGNORE))[seen.index]  # an empty pixel's index is -1
            return seen.image, truth
        seen = self.projector.project(points)
        truth = scan.top_view_truth(TOP_VIEW)
        if self.recipe.network == "lodnn":
            return seen.image, np.where(truth == IGNORE, IGNORE, truth == 1).astype(np.uint8)
        vehicles = [b for b in zip(scan.boxes, scan.counts, strict=True) if b[0].label in TOP_VIEW_CLASSES[2:]]
        found, unsure = (
            np.array([[*b.center, *b.size, b.yaw] for b, n in vehicles if (n >= FEWEST) == hit], np.float64)
            for hit in (True, False)
        )
        if self.recipe.head == "slots":
            boxes = slot_targets(found, TOP_VIEW, N_SLOTS)
        else:
            boxes = dense_targets(found, TOP_VIEW, labelled=scan.labelled(TOP_VIEW), unsure=unsure)
        return seen.image, truth, boxes


def loss_of(recipe: Recipe, outputs: Tensor | tuple[Tensor, Tensor], targets: Sequence[Tensor]) -> Tensor:
    """The loss of a recipe."""
    if recipe.labels_points:
        weights = torch.tensor(POINT_WEIGHTS, device=targets[0].device) if recipe.class_weights else None
        how = {"focal_gamma": recipe.focal_gamma, "lovasz_weight": recipe.lovasz_weight}
        if not isinstance(outputs, tuple):
            return pointseg_loss(outputs, targets[0], weights, **how)
        logits, early = outputs
        # The nearest of every four columns: a mean of labels would be none.
        coarse = targets[0][:, :, 1 :: targets[0].shape[2] // early.shape[3]]
        loss = pointseg_loss(logits, targets[0], weights, **how)
        return loss + recipe.deep_supervision * pointseg_loss(early, coarse, weights, **how)
    if recipe.network == "lodnn":
        assert isinstance(outputs, Tensor)
        return road_loss(outputs, targets[0], recipe.lovasz_weight)
    weights = torch.tensor(TOP_VIEW_WEIGHTS, device=targets[0].device) if recipe.class_weights else None
    lw_det = LW_DET_DENSE if recipe.head == "dense" else 0.1
    how = {"lw_det": lw_det, "class_weights": weights, "lovasz_weight": recipe.lovasz_weight}
    return ssadnet_loss(*outputs, *targets, **how)[0]


def _distilled(recipe: Recipe, teacher: nn.Module, x: Tensor, outputs: Tensor | tuple[Tensor, Tensor]) -> Tensor:
    probabilities, boxes = taught(teacher, x, recipe.network, mirror=recipe.seen_twice)
    logits = outputs[0] if isinstance(outputs, tuple) else outputs
    if recipe.network == "lodnn":  # its teacher tells vehicles from the rest, too
        probabilities = torch.stack([1.0 - probabilities[:, 1], probabilities[:, 1]], dim=1)
    loss = distillation_loss(logits, probabilities)
    if recipe.network == "ssadnet" and recipe.head == "dense":
        loss = loss + LW_DET_DENSE * box_distillation_loss(outputs[1], boxes)
    return loss


class RealScans(NamedTuple):
    """Real scans that somebody labelled otherwise than KITTI does, as with roads drawn by hand.

    Attributes
    ----------
    scans : list of LabelledScan
        To train on.
    hashes : dict of str to str
        The name of each and its `edgeperc.datasets.scan_hash`, for the card.
    watched : list of LabelledScan
        To stop and to lower the learning rate by.
    """

    scans: list[LabelledScan]
    hashes: dict[str, str]
    watched: list[LabelledScan]


def real_scans(
    kitti: KittiObjects, names: Sequence[str], *, drawn: bool = False
) -> tuple[list[LabelledScan], list[float], dict[str, str]]:
    """Labelled scans, how often to draw each, and the SHA-256 of each file; ``drawn``: with roads drawn by hand."""
    scans, weights, hashes = [], [], {}
    roads = drawn_roads() if drawn else {}
    frames = [kitti.frame(n) for n in tqdm(names, desc="reading real scans", leave=False)]
    drives = [f.drive for f in frames]
    for frame in frames:
        scan = LabelledScan.from_frame(frame, sure_surface)
        hashes[frame.name] = digest = scan_hash(frame.points)
        if digest in roads:
            scan = replace(scan, surface=with_road(scan.surface, roads[digest]))
        scans.append(scan)
        # A drive counts with the square root of its frames: 154 neighbours are not 154 scenes. A drawn road counts
        # as a drive of its own, for its truth is whole.
        weights.append(1.0 if digest in roads else drives.count(frame.drive) ** -0.5)
    return scans, weights, hashes


def train(
    recipe: Recipe,
    out: Path,
    *,
    kitti: Path | None,
    simulated: Path | None,
    given: RealScans | None = None,
    fold: int | None = None,
    start_from: Path | None = None,
    teacher: Path | None = None,
    n_threads: int | None = None,
    compiled: bool = False,
    checkpoint_every: int = 100,
) -> Path:
    """Train, or go on training, the network of a recipe.

    Parameters
    ----------
    recipe : Recipe
    out : Path
        Folder for ``checkpoint.pt`` and ``log.jsonl``. A checkpoint already there, of the same recipe, is resumed.
    kitti : Path or None
        Root of a KITTI object set; frames of test drives are left out, and so are all where the recipe's
        ``simulated_share`` is 1.
    simulated : Path or None
        Folder of scans from ``edgeperc-export simulate``.
    given : RealScans, optional
        In place of ``kitti``'s.
    fold : int, optional
        Fold of the training drives that is not trained on but watched: every ``checkpoint_every`` steps the averaged
        network is judged on it, and the best is kept (early stopping). Without real scans to train on, all training
        drives are watched.
    start_from : Path or None
        A checkpoint whose weights a new run starts from; what the recipe's network lacks or has besides is left.
    teacher : Path or None
        A checkpoint that the recipe distils from; where it distils nothing, a PointSeg that labels what nobody labelled
        in the real scans of the training drives.
    n_threads : int or None
    compiled : bool
        Through `torch.compile`: a minute and a C++ compiler first, then PointSeg is a third faster.
    checkpoint_every : int
        Steps between checkpoints.

    Returns
    -------
    Path
        Of the last checkpoint.
    """
    out.mkdir(parents=True, exist_ok=True)
    if n_threads is not None:
        torch.set_num_threads(n_threads)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    objects = KittiObjects(kitti) if kitti else None
    real, hashes, watched = given or RealScans([], {}, [])
    weights = [1.0] * len(real)
    if objects:
        only_simulated = recipe.simulated_share == 1.0
        names = objects.names("train") if only_simulated else objects.names("validation", fold=fold)
        watched = [LabelledScan.from_frame(objects.frame(n), sure_surface) for n in names[::VALIDATION_STRIDE]]
        names = [] if only_simulated else objects.names("train", fold=fold)
        real, weights, hashes = real_scans(objects, names, drawn=recipe.drawn_roads)
    if recipe.distil > 0.0 and teacher is None:
        raise ValueError(f"the recipe distils ({recipe.distil:g}) from no teacher; give --teacher")
    tutor = None if teacher is None else _teacher(teacher).to(device)
    if tutor is not None and objects is not None and recipe.distil == 0.0:
        extra = unlabelled_scans(objects, fold)
        real = pseudo_labelled(tutor.cpu(), [*real, *extra])
        weights += [len(extra) ** -0.5] * len(extra)
    samples = Samples(recipe, real, weights, sorted(simulated.glob("*.npz")) if simulated else [])
    watch = Watch(recipe, samples, watched) if watched else None

    network = build(recipe)
    before: list[dict[str, object]] = []
    if start_from is not None:
        before = _start(network, start_from)
    network = network.to(device, memory_format=torch.channels_last)
    averaged = copy.deepcopy(network).eval()
    optimizer = _optimizer(recipe, network)
    checkpoint, step = out / "checkpoint.pt", 0
    best, since_best, halvings = None, 0, 0
    best_figure, lowest_loss = -1.0, math.inf
    curve: list[dict[str, Any]] = []
    if checkpoint.exists():
        state = torch.load(checkpoint, weights_only=True, map_location=device)
        if Recipe(**json.loads(state["recipe"])) != recipe:
            raise ValueError(f"{checkpoint} is of another recipe: {state['recipe']}; train into an empty folder")
        before, curve = json.loads(state["before"]), json.loads(state["curve"])
        network.load_state_dict(state["network"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        step, best = state["step"], state["best"]
        best_figure, lowest_loss, since_best, halvings = state["watched"]

    def save() -> None:
        aside = checkpoint.with_suffix(".tmp")
        torch.save(
            {
                "recipe": json.dumps(asdict(recipe)),
                "before": json.dumps(before),
                "step": step,
                "network": network.state_dict(),
                "averaged": averaged.state_dict(),
                "best": best,
                "watched": (best_figure, lowest_loss, since_best, halvings),
                "optimizer": optimizer.state_dict(),
                "curve": json.dumps(curve),
                "frames": json.dumps(hashes),
                "fold": -1 if fold is None else fold,
                "n_simulated": len(samples.simulated),
            },
            aside,
        )
        aside.replace(checkpoint)

    # The averaged network and the checkpoint know the network as it is; compiled, it shares its weights.
    forward = torch.compile(network) if compiled else network
    progress = tqdm(total=recipe.steps, initial=step, desc=recipe.network, unit="step")
    losses: list[float] = []
    with (out / "log.jsonl").open("a") as log, progress:
        for inputs, *targets in _ahead(samples, step, recipe.steps):
            for group in optimizer.param_groups:
                group["lr"] = recipe.learning_rate * _schedule(recipe, step) * 0.5**halvings
            torch.manual_seed((recipe.seed << 32) + step)
            x = torch.from_numpy(inputs).to(device, memory_format=torch.channels_last)
            y = [torch.from_numpy(t).to(device) for t in targets]
            network.train()
            if recipe.head_only:
                network.segmentation.requires_grad_(False).eval()
            with torch.autocast(device.type, torch.bfloat16):
                outputs = forward(x)
            loss = loss_of(recipe, outputs, y)
            if tutor is not None and recipe.distil > 0.0:
                loss = loss + recipe.distil * _distilled(recipe, tutor, x, outputs)
            if not torch.isfinite(loss):
                raise FloatingPointError(f"the loss is {loss.item()} at step {step}; lower --learning-rate")
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimizer.step()
            step += 1
            _average(averaged, network, min(recipe.ema, (1 + step) / (10 + step)))
            losses.append(loss.item())
            progress.update()
            progress.set_postfix(loss=f"{losses[-1]:.3f}")
            if step % checkpoint_every == 0 or step == recipe.steps:
                line: dict[str, Any] = {"step": step, "loss": round(float(np.mean(losses)), 5)}
                losses.clear()
                if watch is not None:
                    figure, watched_loss, figures = watch.judge(averaged)
                    line |= {"validation_loss": round(watched_loss, 5), "validation": figures}
                    if figure > best_figure:
                        best_figure, best = figure, copy.deepcopy(averaged.state_dict())
                    since_best = 0 if watched_loss < lowest_loss else since_best + checkpoint_every
                    lowest_loss = min(lowest_loss, watched_loss)
                    epoch = max(1, len(real) // recipe.batch)
                    if recipe.halve_after and since_best >= recipe.halve_after * epoch:
                        halvings, since_best = halvings + 1, 0
                curve.append(line)
                log.write(json.dumps(line) + "\n")
                log.flush()
                save()
    return checkpoint


class Watch:
    """Judges a network on real frames that it is not trained on: pixel labels, and boxes where it finds any.

    Parameters
    ----------
    recipe : Recipe
    samples : Samples
        Makes the inputs.
    scans : sequence of LabelledScan
        What to judge by.
    """

    def __init__(self, recipe: Recipe, samples: Samples, scans: Sequence[LabelledScan]) -> None:
        self.recipe, self.card = recipe, card_of(recipe.network, recipe.head, version="0")
        self.inputs = [samples.sample(scan) for scan in scans]
        self.scans = scans

    def judge(self, network: nn.Module) -> tuple[float, float, dict[str, float | None]]:
        """The figure that decides (mean IoU of objects, or AP of boxes), the mean loss, and every figure by name."""
        losses, road_alone = [], self.recipe.network == "lodnn"
        classes = POINT_CLASSES if self.recipe.labels_points else ROAD_CLASSES if road_alone else TOP_VIEW_CLASSES
        pixels, boxes = Confusion(classes), BoxEvaluator()
        device = next(network.parameters()).device
        for (image, *targets), scan in zip(self.inputs, self.scans, strict=True):
            with torch.no_grad():
                outputs = network(torch.from_numpy(image[None]).to(device))
            losses.append(float(loss_of(self.recipe, outputs, [torch.from_numpy(t[None]).to(device) for t in targets])))
            if self.recipe.labels_points or road_alone:
                pixels.update(outputs[0].argmax(0).cpu().numpy(), targets[0])
                continue
            logits, regressed = (output[0].cpu().numpy() for output in outputs)
            answers = {"class_logits": logits, f"box_{self.recipe.head}": regressed}
            labels, found = decode_top_view(self.card, image, answers, self.card.score_threshold)
            pixels.update(labels, targets[0])
            _update(boxes, found, scan)
        figures = {name: _rounded(iou) for name, iou in zip(classes, pixels.iou(), strict=True)}
        if self.recipe.labels_points or road_alone:
            return float(np.nanmean(pixels.iou()[1:])), float(np.mean(losses)), figures
        scores = boxes.overall()
        figures |= {"ap": _rounded(scores.ap), "recall": _rounded(scores.recall)}
        return scores.ap, float(np.mean(losses)), figures


def _ahead(samples: Samples, start: int, stop: int) -> Iterator[tuple[NDArray, ...]]:
    """Batches, the next one made while the last one is learnt from."""
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(samples.batch, start) if start < stop else None
        for step in range(start, stop):
            assert coming is not None
            batch = coming.result()
            coming = pool.submit(samples.batch, step + 1) if step + 1 < stop else None
            yield batch


def _schedule(recipe: Recipe, step: int) -> float:
    """Share of the learning rate: up, level, down."""
    begin = round(recipe.steps * (1.0 - recipe.cooldown))
    if step >= begin:
        return float(0.5 * (1.0 + np.cos(np.pi * (step - begin) / max(1, recipe.steps - begin))))
    return min(1.0, (step + 1) / WARM_UP_STEPS) if recipe.cooldown else 1.0


def _optimizer(recipe: Recipe, network: nn.Module) -> torch.optim.Optimizer:
    if recipe.optimizer == "adagrad":
        return torch.optim.Adagrad(network.parameters(), lr=recipe.learning_rate)
    if recipe.optimizer == "adam":
        return torch.optim.Adam(network.parameters(), lr=recipe.learning_rate)
    if recipe.optimizer != "adamw":
        raise ValueError(f"optimizer is {recipe.optimizer!r}; expected adamw, adam or adagrad")
    decayed = [p for p in network.parameters() if p.ndim > 1]
    kept = [p for p in network.parameters() if p.ndim <= 1]
    return torch.optim.AdamW(
        [{"params": decayed, "weight_decay": recipe.weight_decay}, {"params": kept, "weight_decay": 0.0}],
        lr=recipe.learning_rate,
    )


def _start(network: nn.Module, checkpoint: Path) -> list[dict[str, object]]:
    """Take over what another checkpoint has in common with the network; the recipes that made it."""
    state = torch.load(checkpoint, weights_only=True, map_location="cpu")
    own, theirs = network.state_dict(), state["best"] or state["averaged"]
    common = {name: value for name, value in theirs.items() if name in own and own[name].shape == value.shape}
    if not common:
        raise ValueError(f"{checkpoint} has no weight in common with the recipe's network")
    network.load_state_dict(common, strict=False)
    return [*json.loads(state["before"]), json.loads(state["recipe"])]


def _update(evaluator: BoxEvaluator, found: Sequence[Box], scan: LabelledScan) -> None:
    """Count boxes whose centre is where truth is known."""
    labelled = scan.labelled(TOP_VIEW)

    def judged(box: Box) -> bool:
        row = int((TOP_VIEW.x_range_m[1] - box.center[0]) / TOP_VIEW.cell_m)
        col = int((TOP_VIEW.y_range_m[1] - box.center[1]) / TOP_VIEW.cell_m)
        return 0 <= row < TOP_VIEW.height and 0 <= col < TOP_VIEW.width and bool(labelled[row, col])

    truth, ignored = [], []
    for box, count in zip(scan.boxes, scan.counts, strict=True):
        wanted = box.label in TOP_VIEW_CLASSES[2:] and count >= FEWEST and judged(box)
        (truth if wanted else ignored).append(box)
    evaluator.update([b for b in found if judged(b)], truth, ignored=ignored)


def _teacher(checkpoint: Path) -> nn.Module:
    state = torch.load(checkpoint, weights_only=True, map_location="cpu")
    network = build(Recipe(**json.loads(state["recipe"])))
    network.load_state_dict(state["best"] or state["averaged"])
    return network.eval()


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(float(value), 4)


@torch.no_grad()
def _average(averaged: nn.Module, network: nn.Module, decay: float) -> None:
    for slow, fast in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
        if slow.dtype.is_floating_point:
            slow.lerp_(fast, 1.0 - decay)
        else:
            slow.copy_(fast)
