// An interactive view of cameras and points on a 2D canvas, without WebGL, libraries or requests.
//
// Each <div class="view3d"> holds its data as JSON; reporting/view.py describes it. The world is normalised: x right,
// y down, z ahead, about one unit large. A view is a rotation R (rows: right, down, ahead), a target, a distance
// and a focal length in shorter sides of the canvas.
"use strict";
document.querySelectorAll("div.view3d").forEach((root) => {
  const data = JSON.parse(root.querySelector("script").textContent);
  const canvas = root.querySelector("canvas");
  // Each frame replaces all pixels, so the canvas belongs into the main memory.
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const tip = root.querySelector(".tip"), panel = root.querySelector(".camera");
  const colouring = root.querySelector("select"), photo = root.querySelector("input");
  const MODELS = ["#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7"];
  const ABOVE = [[1, 0, 0], [0, 0.94, -0.34], [0, 0.34, 0.94]];
  const APART = 2.2;  // between the centres of models, which are 2 wide at most

  // Points of all models, side by side: x, y, z and colour.
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const total = data.models.reduce((sum, model) => sum + model.count, 0);
  const points = new Float32Array(3 * total), colours = new Uint32Array(total);
  const cameras = [];
  let filled = 0;
  data.models.forEach((model, number) => {
    const shift = APART * (number - (data.models.length - 1) / 2);
    const places = new Int16Array(bytes(model.points).buffer), rgb = bytes(model.colours);
    for (let i = 0; i < model.count; i++, filled++) {
      for (let axis = 0; axis < 3; axis++) points[3 * filled + axis] = (places[3 * i + axis] * model.range) / 32767;
      points[3 * filled] += shift;
      // The bytes of a pixel are red, green, blue, alpha: little-endian, as in all browsers of today.
      colours[filled] = (255 << 24) | (rgb[3 * i + 2] << 16) | (rgb[3 * i + 1] << 8) | rgb[3 * i];
    }
    model.cameras.forEach((camera) => {
      const [x, y, z] = camera.centre;
      cameras.push({ ...camera, centre: [x + shift, y, z], model: number, size: model.frustum });
    });
  });

  // The chosen camera, the one under the pointer, and the one that the view looks through.
  let selected = null, hovered = null, seen = null;
  let view, pending = false, ratio = 1;
  // All models fit into the canvas, with a margin.
  const reset = () => {
    const [x, y, z] = [0, 1, 2].map((axis) => Math.max(...data.models.map((model) => model.extent[axis])));
    const { width, height } = canvas, focal = 1.2, reach = (focal * Math.min(width, height)) / 0.45;
    const across = x + (APART * (data.models.length - 1)) / 2, upright = y + 0.34 * z;
    const distance = Math.max((reach * across) / width, (reach * upright) / height) + z;
    view = { R: ABOVE, target: [0, 0, 0], distance, focal };
    seen = null;
  };

  // Geometry

  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const along = (a, b, factor) => a.map((value, axis) => value + factor * b[axis]);
  const eye = () => along(view.target, view.R[2], -view.distance);
  const unit = () => view.focal * Math.min(canvas.width, canvas.height);  // pixels of a tangent of 1
  const project = (point) => {
    const ray = along(point, eye(), -1), depth = dot(view.R[2], ray), f = unit() / depth;
    return [canvas.width / 2 + f * dot(view.R[0], ray), canvas.height / 2 + f * dot(view.R[1], ray), depth];
  };
  // The apex and the four corners of a camera's frustum.
  const frustum = (camera) => {
    const size = camera.size * (camera === selected ? 1.5 : 1);
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => {
      const across = along(camera.centre, camera.R[0], size * x * camera.wide);
      return along(along(across, camera.R[1], size * y * camera.high), camera.R[2], size);
    });
    return [camera.centre, ...corners].map(project);
  };
  const turn = (x, y) => {
    // About the world's vertical axis, and about the view's horizontal axis; never upside down.
    const [cx, sx, cy, sy] = [Math.cos(x), Math.sin(x), Math.cos(y), Math.sin(y)];
    const yawed = view.R.map(([a, b, c]) => [cx * a - sx * c, b, sx * a + cx * c]);
    const [right, down, ahead] = yawed;
    const pitched = [right, along(down.map((v) => cy * v), ahead, sy), along(ahead.map((v) => cy * v), down, -sy)];
    view.R = pitched[1][1] > 0.02 ? pitched : yawed;
    seen = null;
  };
  const move = (x, y) => {
    const step = view.distance / (view.focal * Math.min(canvas.clientWidth, canvas.clientHeight));
    view.target = along(along(view.target, view.R[0], -step * x), view.R[1], -step * y);
    seen = null;
  };
  const zoom = (factor) => {
    view.distance = Math.min(60, Math.max(0.02, view.distance * factor));
    seen = null;
  };
  const lookThrough = (camera) => {
    // The distance to the nearest points ahead makes the view turn about what the camera shows.
    const depths = [];
    for (let i = 0; i < total; i++) {
      const ray = along(points.subarray(3 * i, 3 * i + 3), camera.centre, -1), depth = dot(ray, camera.R[2]);
      if (depth > 0 && Math.abs(dot(ray, camera.R[0])) < depth * camera.wide) depths.push(depth);
    }
    const distance = depths.sort((a, b) => a - b)[depths.length >> 1] || 1;
    view = { R: camera.R, distance, focal: 1, target: along(camera.centre, camera.R[2], distance) };
    seen = camera;
    hovered = null;
    tip.hidden = true;
  };

  // Drawing

  const certainty = (camera) => {
    if (!camera.sigmas) return "#888888";
    const part = Math.min(1, Math.max(0, Math.log10(camera.sigmas[1] / 0.05) / 2));  // 0.05 % to 5 % of the model
    return `hsl(${210 - 210 * part} 85% 45%)`;
  };
  const colourOf = (camera) => (colouring.value === "model" ? MODELS[camera.model % MODELS.length] : certainty(camera));
  const draw = () => {
    pending = false;
    const { width, height } = canvas;
    if (!view || !width || !height) return;
    if (seen) {
      const fit = Math.min(width / (2 * seen.wide), height / (2 * seen.high));
      view.focal = fit / Math.min(width, height);
    }
    const image = context.createImageData(width, height), pixels = new Uint32Array(image.data.buffer);
    pixels.fill(0xff1d1816);
    const depths = new Float32Array(width * height).fill(Infinity);
    const at = eye(), f = unit(), [right, down, ahead] = view.R;
    const size = Math.max(0.0022, 0.25 / Math.sqrt(total));  // of a point: larger if there are few
    for (let i = 0; i < total; i++) {
      const x = points[3 * i] - at[0], y = points[3 * i + 1] - at[1], z = points[3 * i + 2] - at[2];
      const depth = ahead[0] * x + ahead[1] * y + ahead[2] * z;
      if (depth < 0.005) continue;
      const u = width / 2 + (f * (right[0] * x + right[1] * y + right[2] * z)) / depth;
      const v = height / 2 + (f * (down[0] * x + down[1] * y + down[2] * z)) / depth;
      const radius = Math.min(4 * ratio, Math.max(0.6 * ratio, (size * f) / depth));
      const left = Math.max(0, Math.round(u - radius)), end = Math.min(width, Math.round(u + radius));
      const bottom = Math.min(height, Math.round(v + radius));
      for (let row = Math.max(0, Math.round(v - radius)); row < bottom; row++) {
        for (let n = row * width + left; n < row * width + end; n++) {
          if (depth < depths[n]) {
            depths[n] = depth;
            pixels[n] = colours[i];
          }
        }
      }
    }
    context.putImageData(image, 0, 0);
    if (seen && seen.picture && photo.value > 0) {
      const [w, h] = [2 * unit() * seen.wide, 2 * unit() * seen.high];
      context.globalAlpha = photo.value / 100;
      context.drawImage(seen.picture, (width - w) / 2, (height - h) / 2, w, h);
      context.globalAlpha = 1;
    }
    if (selected) drawPairs();
    cameras.map((camera) => [camera, frustum(camera)]).sort((a, b) => b[1][0][2] - a[1][0][2]).forEach(drawCamera);
    drawScale();
  };
  const drawCamera = ([camera, ends]) => {
    if (camera === seen || ends.some(([, , depth]) => depth < 0.01)) return;
    const path = (order) => order.forEach((n, i) => context[i ? "lineTo" : "moveTo"](ends[n][0], ends[n][1]));
    context.beginPath();
    path([1, 2, 3, 4, 1]);
    context.fillStyle = context.strokeStyle = colourOf(camera);
    context.globalAlpha = 0.35;
    context.fill();
    context.globalAlpha = 1;
    [1, 2, 3, 4].forEach((n) => path([0, n]));
    if (camera === selected || camera === hovered) context.strokeStyle = "#ffffff";
    context.lineWidth = (camera === selected || camera === hovered ? 2.2 : 1.3) * ratio;
    context.stroke();
  };
  const drawPairs = () => {
    context.lineWidth = ratio;
    context.strokeStyle = "rgba(255, 255, 255, 0.35)";
    context.beginPath();
    const from = project(selected.centre);
    cameras.filter((camera) => camera.model === selected.model).forEach((camera) => {
      const to = project(camera.centre);
      if (!selected.pairs.some(([name]) => name === camera.name) || Math.min(from[2], to[2]) < 0.01) return;
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
    });
    context.stroke();
  };
  // The length of a bar at the target, if metres are known: 1, 2 or 5 of a power of ten.
  const drawScale = () => {
    if (!data.metres) return;
    const perMetre = unit() / view.distance / data.metres, most = (0.3 * canvas.width) / perMetre;
    const power = 10 ** Math.floor(Math.log10(most)), metres = [5, 2, 1].find((n) => n * power <= most) * power;
    const [x, y] = [14 * ratio, canvas.height - 14 * ratio];
    context.fillStyle = "#ffffff";
    context.fillRect(x, y, metres * perMetre, 3 * ratio);
    context.font = `${13 * ratio}px system-ui, sans-serif`;
    context.fillText(`${Number(metres.toPrecision(1))} m`, x, y - 6 * ratio);
  };
  const redraw = () => {
    if (!pending) requestAnimationFrame(draw);
    pending = true;
  };

  // The camera under the pointer, and the chosen one

  const nearest = (x, y, reach) => {
    let best = null, least = reach * ratio;
    if (!view) return best;
    cameras.forEach((camera) => {
      const ends = frustum(camera);
      if (camera === seen || ends[0][2] < 0.01) return;
      const mean = [0, 1].map((axis) => ends.reduce((sum, end) => sum + end[axis], 0) / 5);
      const distance = Math.hypot(mean[0] - x * ratio, mean[1] - y * ratio);
      if (distance < least) [best, least] = [camera, distance];
    });
    return best;
  };
  const hover = (x, y) => {
    hovered = nearest(x, y, 22);
    tip.hidden = !hovered;
    if (hovered) {
      tip.textContent = hovered.name;
      tip.style.left = `${Math.min(x + 12, Math.max(0, canvas.clientWidth - tip.offsetWidth))}px`;
      tip.style.top = `${Math.max(0, y - 30)}px`;
    }
    canvas.style.cursor = hovered ? "pointer" : "grab";
  };
  const element = (tag, text, parent) => {
    const made = Object.assign(document.createElement(tag), { textContent: text });
    return parent.appendChild(made);
  };
  const select = (camera) => {
    selected = camera;
    panel.replaceChildren();
    panel.hidden = !camera;
    if (!camera) return;
    if (camera.thumbnail) {
      panel.append(Object.assign(new Image(), { src: camera.thumbnail, alt: camera.name }));
    }
    const facts = element("div", "", panel);
    element("b", camera.name, facts);
    const through = element("button", "look through this camera", facts);
    through.type = "button";
    through.onclick = () => {
      lookThrough(camera);
      redraw();
    };
    const [rotation, centre, focal] = camera.sigmas || [];
    const sure = camera.sigmas
      ? `expected errors: centre ${centre} % of the model's size, rotation ${rotation}°, focal length ${focal} %`
      : "its expected errors are unknown";
    element("p", `${camera.pixels[0]} x ${camera.pixels[1]} pixels, ${camera.points} points; ${sure}`, facts);
    const list = element("ul", "", facts);
    camera.pairs.forEach(([name, inliers, matches]) => {
      const link = element("button", name, element("li", "", list));
      link.type = "button";
      const other = cameras.find((each) => each.name === name);
      link.disabled = !other;
      link.onclick = () => {
        select(other);
        redraw();
      };
      link.after(` ${inliers} inliers of ${matches} matches`);
    });
  };

  // Mouse, touch, keys

  const held = new Map();  // position of each pressed pointer
  let moved = 0, last = { time: 0 };
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, place(event));
    if (held.size === 1) moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const now = place(event), before = held.get(event.pointerId);
    if (!before) {
      hover(...now);
      redraw();
      return;
    }
    const [x, y] = [now[0] - before[0], now[1] - before[1]];
    moved += Math.abs(x) + Math.abs(y);
    if (held.size === 2) {
      const [other] = [...held].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const apart = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]) || 1;
      zoom(apart(before) / apart(now));
      move(x / 2, y / 2);
    } else if (moved > 4) {
      if (event.shiftKey || event.buttons & 6) move(x, y);
      else turn(-x * 0.008, -y * 0.008);
    }
    held.set(event.pointerId, now);
    redraw();
  });
  const release = (event) => {
    const was = held.delete(event.pointerId);
    if (!was || event.type !== "pointerup" || moved > 4 || held.size) return;
    // Two taps of one place are a double click, by mouse and finger alike.
    const [x, y] = place(event);
    const again = event.timeStamp - last.time < 400 && Math.hypot(x - last.x, y - last.y) < 25;
    const camera = again ? last.camera : nearest(x, y, event.pointerType === "mouse" ? 22 : 36);
    if (!again) select(camera);
    else if (camera) lookThrough(camera);
    else reset();
    last = { x, y, camera, time: again ? 0 : event.timeStamp };
    redraw();
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => {
    hovered = null;
    tip.hidden = true;
    redraw();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(Math.max(-1, Math.min(1, event.deltaY / 400))));
    redraw();
  }, { passive: false });
  const KEYS = {
    ArrowLeft: () => turn(0.1, 0), ArrowRight: () => turn(-0.1, 0), ArrowUp: () => turn(0, 0.1),
    ArrowDown: () => turn(0, -0.1), "+": () => zoom(0.9), "-": () => zoom(1.1), Escape: reset,
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key]();
    redraw();
  });
  root.querySelector(".reset").onclick = () => {
    reset();
    redraw();
  };
  colouring.onchange = photo.oninput = redraw;

  cameras.forEach((camera) => {
    if (!camera.thumbnail) return;
    camera.picture = Object.assign(new Image(), { onload: redraw, src: camera.thumbnail });
  });
  new ResizeObserver(() => {
    ratio = Math.min(2, window.devicePixelRatio || 1);
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    if (!view && canvas.width && canvas.height) reset();
    redraw();
  }).observe(canvas);
});
