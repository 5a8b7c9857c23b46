"""How a network is trained, without importing torch."""

from __future__ import annotations

from dataclasses import dataclass, replace

from .cards import LABELS_POINTS

__all__ = ["MODELS", "PAPER", "Recipe", "Stage"]


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
        Where a road was drawn by hand (`edgeperc_export.roads.drawn_roads`), that is the truth of the scan's surface.
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


@dataclass(frozen=True)
class Stage:
    """One training run on the way to a model.

    Attributes
    ----------
    recipe : Recipe
        One whose ``simulated_share`` is 1 sees no real scan and no real layout, and owes nothing to anybody's terms.
    after : str or None
        The model whose weights the run starts from.
    teacher : str or None
        The model that the run learns from.
    """

    recipe: Recipe
    after: str | None = None
    teacher: str | None = None


# From nothing, and with its teacher's answers from the first step on: the focal loss is SqueezeSegV2's.
KULSEG = Recipe("kulseg", steps=3600, batch=4, focal_gamma=2.0, distil=1.0, seen_twice=False)


# Batches of four: for as many scans twice the steps, and better figures. SSADNet without dropout, which a network that
# sees so few scans does not need, and which upsets batch norm.
SSADNET = Recipe("ssadnet", batch=4, learning_rate=1.5e-3, context_width=64, n_pasted=3.0, dropout=0.0)


EDGE = Recipe("ssadnet", edge=True, steps=6000, batch=4, learning_rate=3e-3, cooldown=0.2, n_pasted=3.0)


TAUGHT = replace(EDGE, steps=1000, learning_rate=1e-3, cooldown=0.4, distil=1.0, seen_twice=False)


# LoDNN-I's plan at a quarter of the resolution, with the answers of the network that draws roads best from the start.
LODNN = Recipe(
    "lodnn",
    edge=True,
    steps=4500,
    batch=4,
    learning_rate=3e-3,
    n_pasted=3.0,
    distil=1.0,
    seen_twice=False,
    drawn_roads=True,
)


MODELS = {
    "pointseg-sim": Stage(Recipe("pointseg", simulated_share=1.0, steps=1000, learning_rate=2e-3, cooldown=0.3)),
    "pointseg": Stage(Recipe("pointseg", steps=3600, batch=4, learning_rate=1e-3), after="pointseg-sim"),
    "kulseg-start": Stage(KULSEG, teacher="pointseg"),
    # Trained on without the focal loss, which on top of class weights makes too many pixels a pedestrian's.
    "kulseg": Stage(
        replace(KULSEG, steps=1500, learning_rate=1e-3, cooldown=0.6, focal_gamma=0.0), "kulseg-start", "pointseg"
    ),
    "ssadnet-sim": Stage(replace(SSADNET, simulated_share=1.0, steps=1300, cooldown=0.3)),
    "ssadnet": Stage(replace(SSADNET, steps=2000), after="ssadnet-sim"),
    # On the very segmentation branch of ssadnet, so that the heads can be compared.
    "ssadnet-paper": Stage(replace(SSADNET, head="slots", head_only=True, steps=1000), after="ssadnet"),
    # A step of a network for small computers takes a quarter of the full one's, a step with its teacher's answers as
    # long: first many on labels alone, then some with both.
    "pointseg-edge-start": Stage(replace(EDGE, network="pointseg", n_pasted=6.0)),
    "pointseg-edge": Stage(
        replace(TAUGHT, network="pointseg", n_pasted=6.0, steps=1600), "pointseg-edge-start", "pointseg"
    ),
    "lodnn": Stage(LODNN, teacher="ssadnet-edge"),
    "ssadnet-edge-start": Stage(EDGE),
    "ssadnet-edge": Stage(TAUGHT, "ssadnet-edge-start", "ssadnet"),
}
