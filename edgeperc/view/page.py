"""The 3-D page: one self-contained HTML file."""

from __future__ import annotations

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_whole
from ..perception import Perception
from .colours import HIGH, LOW, box_corners, check_points, colour_of, ground_height, paint_points, timing_line

__all__ = ["write_html"]


def write_html(points: NDArray[np.float32], perception: Perception, path: str | Path, *, title: str = "") -> None:
    """Write one page that shows the labelled points in a browser, to turn, zoom and pan. It needs no network.

    Parameters
    ----------
    points : (n, 4) float32
        The scan that was perceived: x, y, z [m] in the sensor frame, remission. Rows that are not finite are left out.
    perception : Perception
    path : str or Path
        An existing file is replaced whole.
    title : str
        The scan's name.

    Raises
    ------
    PointsError
        ``points`` is not the scan that was perceived.
    OSError
        The file cannot be written.
    """
    check_points(points, perception)
    names, painted = paint_points(points, perception)
    seen = np.isfinite(points).all(axis=1)
    points, painted = points[seen], painted[seen]
    counts = perception.points.counts() if perception.points is not None else {}
    boxed = [box.label for box in perception.boxes]
    legend = []
    for name in names:
        words = [f"{counts[name]:,} points"] if name in counts else []
        if name in boxed:
            words.append(f"{boxed.count(name)} box{'es' * (boxed.count(name) > 1)}")
        if name == "drivable" and perception.top_view is not None:
            words.append(f"{perception.top_view.drivable_area_m2:.0f} m²")
        legend.append({"name": name, "colour": colour_of(name), "words": ", ".join(words)})
    # Some sensors count remission up to 255, or 65535.
    remission = np.maximum(points[:, 3], 0.0) / max(1.0, float(points[:, 3].max(initial=0.0)))
    scene = {
        "xyz": _base64(points[:, :3].astype("<f4")),
        "remission": _base64((remission * 255.0).astype(np.uint8)),
        "label": _base64(painted),
        "classes": legend,
        "low": LOW,
        "high": HIGH,
        "ground": round(ground_height(points, names, painted), 3),
        "boxes": [
            {
                "corners": np.round(box_corners(box), 3).tolist(),
                "colour": colour_of(box.label),
                "words": f"{box.label} {box.score:.2f}",
            }
            for box in perception.boxes
        ],
    }
    # "<" would let a class name close the script element.
    data = json.dumps(scene, allow_nan=False).replace("<", "\\u003c")
    facts = f"{perception.n_points:,} points · {timing_line(perception)}"
    filled = {
        "@@TITLE@@": html.escape(title or "A scan"),
        "@@WORDS@@": html.escape(facts),
        "@@FITNESS@@": "".join(f"<p class=warn>{html.escape(line)}</p>" for line in perception.fitness),
        "@@SCENE@@": data,
    }
    # In one pass, so that a title that looks like a place to fill stays a title.
    page = re.sub("|".join(filled), lambda match: filled[match.group()], _PAGE)
    write_whole(path, page.encode(errors="replace"))


def _base64(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


_PAGE = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'">
<title>@@TITLE@@</title>
<style>
html, body { margin: 0; height: 100%; overflow: hidden; background: #0b0f14; color: #e8edf2;
  font: 14px/1.5 system-ui, sans-serif; }
canvas { position: absolute; inset: 0; width: 100%; height: 100%; }
#points { touch-action: none; cursor: grab; }
#words { pointer-events: none; }
aside { position: absolute; top: 16px; left: 16px; max-width: min(340px, calc(100% - 64px)); padding: 14px 18px;
  background: #131920e6; border: 1px solid #2a343f; border-radius: 8px; }
h1 { margin: 0; font-size: 17px; overflow-wrap: anywhere; }
p { margin: 2px 0 8px; color: #8b98a7; font-size: 12.5px; overflow-wrap: anywhere; }
p.warn { color: #ffc46b; }
ul { margin: 10px 0 0; padding: 0; list-style: none; }
li i { display: inline-block; width: 11px; height: 11px; margin-right: 9px; border-radius: 2px; }
li span { color: #8b98a7; }
button { padding: 3px 12px; background: #1d2630; color: inherit; border: 1px solid #34414e; border-radius: 5px;
  font: inherit; cursor: pointer; }
button[aria-pressed=true] { background: #e8edf2; color: #0b0f14; }
footer { position: absolute; bottom: 10px; right: 16px; color: #8b98a7; font-size: 12.5px; pointer-events: none; }
#sorry { position: absolute; inset: 45% 10% auto; text-align: center; color: #ffc46b; }
</style>
</head>
<body>
<canvas id="points"></canvas>
<canvas id="words"></canvas>
<div id="sorry" hidden>This browser offers no WebGL, so the points cannot be shown.
Turn hardware acceleration on, or open the page in another browser.</div>
<aside>
<h1>@@TITLE@@</h1>
<p>@@WORDS@@</p>@@FITNESS@@
<div id="modes"></div>
<ul id="legend"></ul>
</aside>
<footer>drag: turn · right-drag or two fingers: move · wheel or pinch: zoom · double-click: reset</footer>
<script id="scene" type="application/json">@@SCENE@@</script>
<script>
"use strict";
const $ = (id) => document.getElementById(id);
const scene = JSON.parse($("scene").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
const xyz = new Float32Array(bytes(scene.xyz).buffer);
const remission = bytes(scene.remission), label = bytes(scene.label), n = label.length;

for (const one of scene.classes) {
  const row = $("legend").appendChild(document.createElement("li"));
  row.appendChild(document.createElement("i")).style.background = one.colour;
  row.append(one.name + " ");
  if (!one.words) row.style.opacity = 0.5;
  row.appendChild(document.createElement("span")).textContent = one.words;
}

// Colours: a byte triple for every point, made anew when another mode is chosen.
const low = rgb(scene.low), high = rgb(scene.high), palette = scene.classes.map((one) => rgb(one.colour));
const ramp = (t) => { t = Math.min(1, Math.max(0, t)); return low.map((v, k) => v + t * (high[k] - v)); };
const warm = (t) => [255 * Math.min(1, 0.15 + 1.4 * t), 255 * (0.2 + 0.75 * t * t), 255 * (0.5 - 0.3 * t)];
const height = (i) => (xyz[3 * i + 2] - scene.ground + 0.3) / 3.3;
const modes = {
  "class": (i) => label[i] ? palette[label[i]] : ramp(height(i)),
  "remission": (i) => warm(Math.sqrt(remission[i] / 255)),
  "height": (i) => warm(Math.min(1, Math.max(0, height(i)))),
};

const canvas = $("points"), gl = canvas.getContext("webgl", {antialias: true}), pen = $("words").getContext("2d");
if (gl) start(); else $("sorry").hidden = false;

function start() {
  const shader = (type, source) => {
    const made = gl.createShader(type);
    gl.shaderSource(made, source);
    gl.compileShader(made);
    gl.attachShader(program, made);
  };
  const program = gl.createProgram();
  shader(gl.VERTEX_SHADER, `
    attribute vec3 at; attribute vec3 tint; uniform mat4 view; uniform float size; varying vec3 colour;
    void main() {
      gl_Position = view * vec4(at, 1.0);
      gl_PointSize = clamp(size / gl_Position.w, 1.5, 12.0);
      colour = tint;
    }`);
  shader(gl.FRAGMENT_SHADER, `
    precision mediump float; varying vec3 colour; uniform float round;
    void main() {
      if (round > 0.5 && length(gl_PointCoord - 0.5) > 0.5) discard;
      gl_FragColor = vec4(colour, 1.0);
    }`);
  gl.linkProgram(program);
  gl.useProgram(program);
  const place = Object.fromEntries(["view", "size", "round"].map((k) => [k, gl.getUniformLocation(program, k)]));
  const load = (data) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return buffer;
  };
  const at = gl.getAttribLocation(program, "at"), tint = gl.getAttribLocation(program, "tint");
  gl.enableVertexAttribArray(at);
  gl.enableVertexAttribArray(tint);
  const use = (positions, colours) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, positions);
    gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, colours);
    gl.vertexAttribPointer(tint, 3, gl.UNSIGNED_BYTE, true, 0, 0);
  };

  // Lines: a ground grid every 10 m, and the boxes with a stroke to where they head.
  const ends = [], tints = [], grid = rgb("#26313c"), reach = 80;
  const line = (a, b, colour) => { ends.push(...a, ...b); tints.push(...colour, ...colour); };
  for (let k = -reach; k <= reach; k += 10) {
    for (let part = -reach; part < reach; part += 10) {
      line([k, part, scene.ground], [k, part + 10, scene.ground], grid);
      line([part, k, scene.ground], [part + 10, k, scene.ground], grid);
    }
  }
  line([0, 0, scene.ground], [0, 0, 0], rgb("#e8edf2"));
  const middle = (...all) => [0, 1, 2].map((k) => all.reduce((sum, p) => sum + p[k], 0) / all.length);
  for (const box of scene.boxes) {
    const c = box.corners, colour = rgb(box.colour);
    for (let k = 0; k < 4; k++) {
      line(c[k], c[(k + 1) % 4], colour);
      line(c[4 + k], c[4 + (k + 1) % 4], colour);
      line(c[k], c[4 + k], colour);
    }
    line(middle(c[0], c[1], c[2], c[3]), middle(c[0], c[3]), colour);
  }
  const points = load(xyz), lines = load(new Float32Array(ends)), lineColours = load(new Uint8Array(tints));
  const pointColours = gl.createBuffer();
  const paint = (mode) => {
    const colours = new Uint8Array(3 * n);
    for (let i = 0; i < n; i++) colours.set(modes[mode](i), 3 * i);
    gl.bindBuffer(gl.ARRAY_BUFFER, pointColours);
    gl.bufferData(gl.ARRAY_BUFFER, colours, gl.STATIC_DRAW);
    for (const button of $("modes").children) button.ariaPressed = String(button.textContent === mode);
    show();
  };

  // The camera looks at a target from a distance, at an azimuth and an elevation.
  let camera;
  const home = () => ({target: [10, 0, scene.ground], distance: 34, azimuth: Math.PI, elevation: 0.42});
  const frame = () => {
    const {target, distance, azimuth, elevation} = camera;
    const flat = [Math.cos(azimuth), Math.sin(azimuth)], level = Math.cos(elevation);
    const back = [level * flat[0], level * flat[1], Math.sin(elevation)], right = [-flat[1], flat[0], 0];
    const up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2],
      back[0] * right[1] - back[1] * right[0]];
    return {right, up, back, eye: target.map((t, k) => t + distance * back[k])};
  };
  const matrix = () => {
    const {right, up, back, eye} = frame(), f = 1.7, near = 0.3, far = 500;
    const dot = (a) => -(a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2]);
    const sx = f * canvas.height / canvas.width, a = -(far + near) / (far - near), b = -2 * far * near / (far - near);
    const out = [];
    for (let k = 0; k < 3; k++) out.push(sx * right[k], f * up[k], a * back[k], -back[k]);
    out.push(sx * dot(right), f * dot(up), a * dot(back) + b, -dot(back));
    return out;
  };
  let waiting = false;
  const show = () => { if (!waiting) { waiting = true; requestAnimationFrame(render); } };
  function render() {
    waiting = false;
    const ratio = window.devicePixelRatio || 1;
    for (const one of [canvas, $("words")]) {
      const [w, h] = [Math.round(one.clientWidth * ratio), Math.round(one.clientHeight * ratio)];
      if (one.width !== w || one.height !== h) { one.width = w; one.height = h; }
    }
    const m = matrix();
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.043, 0.059, 0.078, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(place.view, false, m);
    gl.uniform1f(place.size, 0.075 * canvas.height);
    gl.uniform1f(place.round, 0);
    use(lines, lineColours);
    gl.drawArrays(gl.LINES, 0, ends.length / 3);
    gl.uniform1f(place.round, 1);
    use(points, pointColours);
    gl.drawArrays(gl.POINTS, 0, n);
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.textAlign = "center";
    const taken = [];
    const say = (p, words, colour, size) => {
      const q = [0, 1, 2, 3].map((k) => m[k] * p[0] + m[4 + k] * p[1] + m[8 + k] * p[2] + m[12 + k]);
      if (q[3] < 0.3) return;
      const x = (q[0] / q[3] + 1) / 2 * canvas.width, y = (1 - q[1] / q[3]) / 2 * canvas.height;
      pen.font = `600 ${size * ratio}px system-ui, sans-serif`;
      const wide = pen.measureText(words).width, tall = size * ratio;
      const meets = ([u, v, w]) => Math.abs(u - x) < (w + wide) / 2 && Math.abs(v - y) < 1.3 * tall;
      if (size < 12 && taken.some(meets)) return;
      taken.push([x, y, wide]);
      pen.lineWidth = 4 * ratio;
      pen.strokeStyle = "#0b0f14cc";
      pen.strokeText(words, x, y - 5 * ratio);
      pen.fillStyle = colour;
      pen.fillText(words, x, y - 5 * ratio);
    };
    for (const box of scene.boxes) say(middle(...box.corners.slice(4)), box.words, box.colour, 13);
    for (let k = 10; k <= 50; k += 10) say([k, 0, scene.ground], `${k} m`, "#8b98a7", 11);
    for (let k = -30; k <= 30; k += 10) if (k) say([0, k, scene.ground], `${Math.abs(k)} m`, "#8b98a7", 11);
  }

  const turn = (dx, dy) => {
    camera.azimuth -= dx * 0.006;
    camera.elevation = Math.min(1.57, Math.max(-0.1, camera.elevation + dy * 0.006));
  };
  const move = (dx, dy) => {
    const {right, up} = frame(), step = camera.distance * 1.18 / canvas.clientHeight;
    camera.target = camera.target.map((t, k) => t + step * (dy * up[k] - dx * right[k]));
  };
  const zoom = (by) => { camera.distance = Math.min(250, Math.max(2, camera.distance * by)); };
  const held = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    held.set(e.pointerId, [e.clientX, e.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => held.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const was = held.get(e.pointerId);
    if (!was) return;
    const [dx, dy] = [e.clientX - was[0], e.clientY - was[1]];
    const apart = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]) || 1; };
    const before = held.size === 2 ? apart() : 0;
    held.set(e.pointerId, [e.clientX, e.clientY]);
    if (held.size === 2) { zoom(before / apart()); move(dx / 2, dy / 2); }
    else if (e.buttons & 6 || e.shiftKey) move(dx, dy);
    else turn(dx, dy);
    show();
  });
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    zoom(Math.exp((e.deltaMode ? 30 : 1) * e.deltaY * 0.001));
    show();
  }, {passive: false});
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("dblclick", () => { camera = home(); show(); });
  canvas.addEventListener("webglcontextlost", () => { $("sorry").hidden = false; });
  window.addEventListener("resize", show);
  for (const mode of Object.keys(modes)) {
    const button = $("modes").appendChild(document.createElement("button"));
    button.textContent = mode;
    button.addEventListener("click", () => paint(mode));
    $("modes").append(" ");
  }
  camera = home();
  paint("class");
}
</script>
</body>
</html>
"""
