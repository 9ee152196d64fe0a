"""What a page of a generated episode looks like, on top of a check's page, and the script that moves clips and cursors together.

Without the script each clip is a video with its own controls. With it a clip's four panels are cut apart, so that they can stand
two by two on a phone.
"""

STYLE = """
.transport { position: sticky; top: 0; z-index: 2; display: none; grid-template-columns: auto 1fr auto; gap: 2px 12px;
  align-items: center; background: var(--paper); padding: 10px 0 8px; border-bottom: 1px solid var(--rule); }
.js .transport { display: grid; }
.transport button, .transport select { font: inherit; font-size: 14px; color: var(--ink); background: var(--card);
  border: 1px solid var(--rule); border-radius: 8px; padding: 6px 12px; min-width: 72px; cursor: pointer; }
.transport select { min-width: 0; padding: 6px; }
.transport input { width: 100%; margin: 0; accent-color: var(--line); } .transport output { grid-column: 1 / -1; font-size: 13px;
  color: var(--soft); font-variant-numeric: tabular-nums; }
.clip { margin: 0 0 26px; } .clip h3 { margin: 20px 0 8px; }
.clip .names { display: grid; grid-template-columns: repeat(4, 1fr); font-size: 13px; color: var(--soft); }
.clip video { width: 100%; display: block; background: #000; border-radius: 8px; image-rendering: pixelated; }
.js .clip .names { display: none; } .js .clip video { position: absolute; width: 1px; height: 1px; opacity: 0; pointer-events: none; }
.panels { display: none; grid-template-columns: repeat(4, 1fr); gap: 10px; } .js .panels { display: grid; } .panels figure { margin: 0; }
.panels canvas { width: 100%; display: block; border-radius: 8px; border: 1px solid var(--rule); image-rendering: pixelated;
  background: #000; }
.panels figcaption { font-size: 13px; color: var(--soft); margin-top: 4px; }
.panels .imagined figcaption { color: var(--line); font-weight: 600; }
.plot { position: relative; background: var(--card); border: 1px solid var(--rule); border-radius: 10px; margin: 0 0 8px;
  padding: 22px 0 4px; cursor: crosshair; overflow: hidden; }
.plot svg { display: block; width: 100%; height: 104px; } .plot svg path { fill: none; vector-effect: non-scaling-stroke; }
.plot .name { position: absolute; left: 10px; top: 3px; font-size: 13px; font-weight: 600; }
.plot .range { position: absolute; right: 10px; top: 4px; font-size: 12px; color: var(--soft); font-variant-numeric: tabular-nums; }
.plot path.mark { stroke: var(--rule); stroke-width: 1; }
.plot path.imagined, .plot path.predicted { stroke: var(--line); stroke-width: 2; }
.plot path.reconstructed, .plot path.recorded { stroke: var(--soft); stroke-width: 1.4; opacity: .75; }
.plot .cursor { position: absolute; top: 0; bottom: 0; left: 0; width: 0; border-left: 1.5px solid var(--error); display: none;
  pointer-events: none; }
.js .plot .cursor { display: block; }
.key { font-size: 13px; color: var(--soft); margin: 0 0 8px; } .key b { font-weight: 600; color: var(--line); } .key i { font-style: normal;
  border-bottom: 2px solid var(--soft); }
.wide { overflow-x: auto; margin: 0 0 18px; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; width: 100%; }
caption { text-align: left; font-weight: 600; padding: 0 0 6px; }
th, td { text-align: right; padding: 5px 12px 5px 0; border-bottom: 1px solid var(--rule); white-space: nowrap; }
th { font-weight: 600; color: var(--soft); font-size: 13px; white-space: normal; vertical-align: bottom; }
tr.all td { font-weight: 600; } th:first-child, td:first-child { text-align: left; }
.made { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; font-size: 14px; margin: 0; } .made dt { color: var(--soft); }
.made dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 640px) { .panels { grid-template-columns: repeat(2, 1fr); gap: 8px; } .plot svg { height: 84px; }
  td { padding-right: 5px; font-size: 12.5px; } th { padding-right: 5px; font-size: 11px; } .tally li { flex: 1 1 40%; } }
"""

SCRIPT = """
(() => {
  const told = JSON.parse(document.getElementById("frames").textContent), n = told.at.length, fps = told.fps;
  const videos = [...document.querySelectorAll(".clip video")], first = videos[0];
  const slider = document.querySelector(".transport input"), play = document.querySelector(".transport button");
  const speed = document.querySelector(".transport select"), says = document.querySelector(".transport output");
  const cursors = [...document.querySelectorAll(".plot .cursor")];
  const panels = videos.map(video => [...video.closest(".clip").querySelectorAll("canvas")]);
  document.documentElement.classList.add("js");
  videos.forEach(video => { video.controls = false; video.loop = video === first; });
  const cut = (picture, to) => to.forEach((canvas, i) => {
    canvas.getContext("2d").drawImage(picture, i * canvas.width, 0, canvas.width, canvas.height, 0, 0, canvas.width, canvas.height); });
  const draw = i => videos[i].readyState >= 2 && cut(videos[i], panels[i]);
  const frame = () => Math.min(n - 1, Math.max(0, Math.floor(first.currentTime * fps + 1e-3)));
  const tell = k => {
    slider.value = k;
    cursors.forEach(cursor => cursor.style.left = 100 * told.at[k] + "%");
    says.textContent = `${told.seconds[k].toFixed(1)} s, step ${told.step[k]}: imagined ${told.ahead[k]} steps ahead by plan ` +
      `${told.plan[k] + 1} of ${told.plans}`; };
  const show = () => { videos.forEach((_, i) => draw(i)); tell(frame()); };
  const seek = k => { tell(k); videos.forEach(video => video.currentTime = (k + 0.5) / fps); };
  const tick = () => {
    if (first.paused) return;
    videos.slice(1).forEach(video => {
      if (Math.abs(video.currentTime - first.currentTime) > 0.6 / fps) video.currentTime = first.currentTime; });
    show(); requestAnimationFrame(tick); };
  play.onclick = () => first.paused ? videos.forEach(video => video.play()) : videos.forEach(video => video.pause());
  first.onplay = () => { play.textContent = "Pause"; requestAnimationFrame(tick); };
  first.onpause = () => play.textContent = "Play";
  slider.oninput = () => { videos.forEach(video => video.pause()); seek(+slider.value); };
  speed.onchange = () => videos.forEach(video => video.playbackRate = +speed.value);
  videos.forEach((video, i) => {
    video.onseeked = () => draw(i);
    video.onloadeddata = () => { if (i === 0) seek(told.begin); else video.currentTime = (told.begin + 0.5) / fps; };
    if (video.readyState >= 2) video.onloadeddata(); });
  videos.forEach((video, i) => {
    const still = new Image();
    still.onload = () => video.readyState < 2 && cut(still, panels[i]);
    still.src = video.poster; });
  const nearest = at => told.at.reduce((best, x, k) => Math.abs(x - at) < Math.abs(told.at[best] - at) ? k : best, 0);
  document.querySelectorAll(".plot").forEach(plot => {
    const move = event => { const box = plot.getBoundingClientRect(); videos.forEach(video => video.pause());
      seek(nearest((event.clientX - box.left) / box.width)); };
    plot.onpointerdown = move; plot.onpointermove = event => event.buttons && move(event); });
  document.onkeydown = event => {
    if (event.key === " " && event.target === document.body) { event.preventDefault(); play.click(); }
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (by && event.target !== slider) { videos.forEach(video => video.pause()); seek(Math.min(n - 1, Math.max(0, frame() + by))); } };
})();
"""
