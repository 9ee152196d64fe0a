"""What the page of a dataset looks like, on top of a check's page, and the script that filters and sorts its cards.

Without the script every card is there, in the order of the index, and opens: a card is a `details`. The filters appear with it.
"""

STYLE = """
main { max-width: 1400px; }
.tally li.small b { font-size: 20px; line-height: 1.7; }
.holds { margin: 20px 0 0; } .holds > summary, .findings > summary { font-weight: 600; padding: 6px 0; }
.about { display: grid; grid-template-columns: max-content 1fr; gap: 3px 18px; font-size: 14px; margin: 4px 0 0; }
.about dt { color: var(--soft); } .about dd { margin: 0; overflow-wrap: anywhere; } .about .wrong { color: var(--error); }
.filters { position: sticky; top: 0; z-index: 3; display: none; flex-wrap: wrap; gap: 8px 10px; align-items: end; background: var(--paper);
  border-bottom: 1px solid var(--rule); padding: 10px 2px; margin: 0 -2px 16px; font-size: 13px; }
.js .filters { display: flex; }
.filters label { display: flex; flex-direction: column; color: var(--soft); gap: 2px; max-width: 210px; flex: 0 1 auto; min-width: 0; }
.filters label.find { flex: 1 1 200px; max-width: 340px; }
.filters input, .filters select, .filters button { font: inherit; font-size: 14px; color: var(--ink); background: var(--card);
  border: 1px solid var(--rule); border-radius: 8px; padding: 6px 8px; min-width: 0; width: 100%; height: 36px; }
.filters button { width: auto; cursor: pointer; padding: 6px 14px; } .filters select.chosen { border-color: var(--line);
  box-shadow: 0 0 0 1px var(--line); }
.filters .more { display: none; } .filters output { margin-left: auto; align-self: center; font-size: 14px; font-weight: 600;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
.episodes { display: grid; grid-template-columns: repeat(auto-fill, minmax(290px, 1fr)); gap: 14px; grid-auto-flow: dense; }
.episode { background: var(--card); border: 1px solid var(--rule); border-radius: 12px; overflow: hidden; min-width: 0;
  content-visibility: auto; contain-intrinsic-size: auto 260px; }
.episode[hidden] { display: none; } .episode[open] { grid-column: 1 / -1; content-visibility: visible; }
.episode > summary { display: block; padding: 10px; list-style: none; } .episode > summary::-webkit-details-marker { display: none; }
.episode > summary:hover { background: var(--code); } .episode:focus-within { border-color: var(--line); }
.film { display: grid; grid-template-columns: repeat(3, 1fr); gap: 3px; margin: 0 0 3px; align-items: start; }
.film + .film { margin-top: 3px; } .frame { display: none; min-width: 0; } .frame.key { display: block; }
.frame img { display: block; width: 100%; height: auto; border-radius: 5px; background: var(--code); }
.frame small, .film .view { display: none; font-size: 12px; color: var(--soft); font-variant-numeric: tabular-nums; }
.episode[open] .film { grid-template-columns: repeat(auto-fill, minmax(190px, 1fr)); gap: 8px; margin-bottom: 12px; }
.episode[open] .frame, .episode[open] .frame small { display: block; } .episode[open] .film .view { display: block; grid-column: 1 / -1;
  font-size: 13px; font-weight: 600; }
.none-to-show { display: flex; align-items: center; justify-content: center; min-height: 60px; padding: 4px 10px; text-align: center;
  background: var(--code); border-radius: 5px; color: var(--soft); font-size: 13px; }
.span { display: block; height: 3px; border-radius: 2px; background: var(--code); margin: 7px 0 6px; }
.span i { display: block; height: 100%; border-radius: 2px; background: var(--line); }
.episode .id { display: block; font-weight: 600; line-height: 1.35; }
.line { stroke: var(--line); } .numbers { display: flex; flex-wrap: wrap; gap: 0 12px; font-size: 13px; color: var(--soft); margin-top: 3px;
  font-variant-numeric: tabular-nums; } .numbers b { color: var(--ink); font-weight: 600; }
.chips { display: flex; flex-wrap: wrap; gap: 5px; margin-top: 7px; font-size: 12.5px; }
.chip { background: var(--code); border-radius: 6px; padding: 1px 8px; color: var(--soft); overflow-wrap: anywhere; }
.chip.validation { color: var(--line); } .chip.success { color: var(--good); } .chip.failure { color: var(--error); }
.chip.set { border: 1px solid var(--rule); padding: 0 7px; } .chip.error, .chip.warning, .chip.note { font-weight: 600; }
.chip.error { color: var(--error); } .chip.warning { color: var(--warning); } .chip.note { color: var(--note); }
.inside { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); gap: 4px 36px; padding: 0 10px 14px; }
.inside h3 { margin: 12px 0 4px; font-size: 14px; } .inside > div > :first-child { margin-top: 6px; }
.inside dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 16px;
  font-size: 13.5px; margin: 0; } .inside dt { color: var(--soft); } .inside dd { margin: 0; overflow-wrap: anywhere; }
.said { list-style: none; margin: 0; padding: 0; font-size: 13.5px; } .said li { margin: 0 0 7px; padding-left: 10px;
  border-left: 3px solid var(--soft); overflow-wrap: anywhere; } .said li.error { border-color: var(--error); }
.said li.warning { border-color: var(--warning); } .said li.note { border-color: var(--note); }
.nothing { display: none; padding: 40px 0; text-align: center; } .js .nothing.shown { display: block; }
.findings { margin: 10px 0 0; } .findings .badge { font-size: inherit; }
.findings .tally { margin: 8px 0 14px; } .findings .finding { max-width: 1000px; }
h2 { margin-top: 30px; }
@media (max-width: 640px) {
  .episodes { grid-template-columns: 1fr; gap: 10px; } .filters { gap: 8px; padding: 8px 2px; } .filters label.find { flex: 1 1 120px; }
  .filters label.find span, .filters label.sort span { display: none; } .filters label.sort { flex: 0 1 122px; }
  .filters .more { display: block; } .filters label.choice, .filters button.reset { display: none; }
  .filters label.choice, .filters button.reset, .filters output { order: 1; }
  .filters.open label.choice { display: flex; flex: 1 1 42%; max-width: none; } .filters.open button.reset { display: block; }
  .filters output { flex: 1 1 auto; margin: 0; font-size: 13px; }
  .about { grid-template-columns: 1fr; gap: 0; } .about dd { margin-bottom: 7px; }
  .inside dl { grid-template-columns: minmax(84px, max-content) 1fr; }
  .episode[open] .film { grid-template-columns: repeat(3, 1fr); gap: 5px; } .inside { padding: 0 10px 12px; }
  .tally li.small { flex: 1 1 28%; font-size: 13px; padding: 6px 10px; } .tally li.small b { font-size: 17px; line-height: 1.4; }
  h2 { margin-top: 22px; } }
@media (max-width: 640px) and (max-height: 500px) { .filters { position: static; } }
@media print { .filters { display: none !important; } .episode { break-inside: avoid; content-visibility: visible; } }
"""

SCRIPT = """
(() => {
  const form = document.querySelector(".filters"), grid = document.querySelector(".episodes"), says = form.querySelector("output");
  const nothing = document.querySelector(".nothing"), find = form.querySelector("input"), sort = form.querySelector(".sort select");
  const choices = [...form.querySelectorAll(".choice select")];
  const cards = [...grid.children].map((card, order) => ({ card, order, has: new Set(card.dataset.has.split(" ")), text: card.dataset.text,
    seconds: +card.dataset.seconds, findings: +card.dataset.findings, psnr: card.dataset.psnr ? +card.dataset.psnr : null }));
  document.documentElement.classList.add("js");
  if (innerWidth <= 640) document.querySelector(".holds").open = false;
  const filter = () => {
    const wanted = choices.map(choice => choice.value).filter(Boolean);
    const words = find.value.toLowerCase().split(/\\s+/).filter(Boolean);
    let shown = 0, seconds = 0;
    for (const one of cards) {
      const fits = wanted.every(value => one.has.has(value)) && words.every(word => one.text.includes(word));
      one.card.hidden = !fits;
      if (fits) { shown += 1; seconds += one.seconds; } }
    choices.forEach(choice => choice.classList.toggle("chosen", choice.value !== ""));
    const time = seconds < 120 ? seconds.toFixed(1) + " s" : (seconds / 60).toFixed(1) + " min";
    says.textContent = `${shown} of ${cards.length} shown, ${time}`;
    nothing.classList.toggle("shown", shown === 0); };
  const order = () => {
    const [by, sign] = sort.value.split(" ");
    const known = one => one[by] !== null;
    cards.sort((a, b) => (known(b) - known(a)) || sign * ((a[by] ?? 0) - (b[by] ?? 0)) || a.order - b.order);
    grid.append(...cards.map(one => one.card)); };
  form.oninput = filter;
  form.onsubmit = event => event.preventDefault();
  sort.onchange = order;
  form.onreset = () => setTimeout(() => { filter(); order(); });
  form.querySelector(".more").onclick = event => event.target.setAttribute("aria-expanded", form.classList.toggle("open"));
  grid.addEventListener("toggle", event => {
    if (!event.target.open || !event.target.classList.contains("episode")) return;
    const top = event.target.getBoundingClientRect().top, under = form.offsetHeight;
    if (top < under || top > innerHeight / 2) scrollBy({ top: top - under - 8, behavior: "smooth" }); }, true);
  filter(); order();
})();
"""
