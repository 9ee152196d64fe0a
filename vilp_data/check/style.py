"""The style sheet of a check's page: a desktop and a phone, light and dark, and nothing from elsewhere."""

STYLE = """
:root { color-scheme: light dark; --paper: #fbfaf8; --card: #ffffff; --ink: #1c1b19; --soft: #6a665f; --rule: #e4e0d8;
  --error: #c0341d; --warning: #b07408; --note: #3b6ea5; --good: #2f7d4f; --area: #b9c7d6; --line: #3b6ea5; --code: #f3f0ea; }
@media (prefers-color-scheme: dark) { :root { --paper: #16171a; --card: #1f2125; --ink: #e9e7e2; --soft: #9c988f; --rule: #34363c;
  --error: #ff7a62; --warning: #e5ad4a; --note: #86b4e6; --good: #6cc893; --area: #3d4c5f; --line: #86b4e6; --code: #282a2f; } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 40px 24px 80px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 6px; letter-spacing: -0.01em; overflow-wrap: anywhere; }
h2 { font-size: 20px; margin: 48px 0 14px; letter-spacing: -0.005em; }
h3 { font-size: 16px; margin: 28px 0 8px; }
p { margin: 0 0 10px; } .soft { color: var(--soft); }
code, .mono { font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace; font-size: 0.86em;
  overflow-wrap: anywhere; }
.tally { display: flex; flex-wrap: wrap; gap: 12px; margin: 22px 0 0; padding: 0; list-style: none; }
.tally li { background: var(--card); border: 1px solid var(--rule); border-radius: 12px; padding: 10px 18px 8px; min-width: 108px; }
.tally b { display: block; font-size: 28px; line-height: 1.15; font-variant-numeric: tabular-nums; }
.tally .none b { color: var(--soft); opacity: .55; } .tally .error b { color: var(--error); } .tally .warning b { color: var(--warning); }
.tally .note b { color: var(--note); } .tally .good b { color: var(--good); }
.finding { background: var(--card); border: 1px solid var(--rule); border-left: 5px solid var(--soft); border-radius: 10px;
  padding: 14px 18px; margin: 0 0 12px; }
.finding.error { border-left-color: var(--error); } .finding.warning { border-left-color: var(--warning); }
.finding.note { border-left-color: var(--note); }
.finding .head { display: flex; flex-wrap: wrap; gap: 4px 12px; align-items: baseline; font-size: 14px; }
.finding .what { font-weight: 600; margin: 4px 0 6px; overflow-wrap: anywhere; }
.label { font-size: 12px; font-weight: 700; letter-spacing: .06em; text-transform: uppercase; }
.error .label { color: var(--error); } .warning .label { color: var(--warning); } .note .label { color: var(--note); }
.evidence { display: flex; flex-wrap: wrap; gap: 6px; margin: 0 0 6px; padding: 0; list-style: none; font-size: 13px; }
.evidence li { background: var(--code); border-radius: 6px; padding: 1px 8px; color: var(--soft); overflow-wrap: anywhere; }
.evidence b { color: var(--ink); font-weight: 600; font-variant-numeric: tabular-nums; }
.remedy { margin: 6px 0 0; padding-left: 20px; position: relative; font-size: 15px; overflow-wrap: anywhere; }
.remedy::before { content: "\\2192"; position: absolute; left: 0; color: var(--good); font-weight: 700; }
.remedy code { background: var(--code); border-radius: 5px; padding: 1px 5px; }
details.more { margin-top: 8px; font-size: 14px; } summary { cursor: pointer; } details.more ul { margin: 8px 0 0; padding-left: 18px; }
details.more li { margin: 2px 0; overflow-wrap: anywhere; }
.fits { display: flex; flex-wrap: wrap; gap: 16px; }
.fits figure { background: var(--card); border: 1px solid var(--rule); border-radius: 12px; padding: 14px 16px; margin: 0;
  flex: 1 1 320px; max-width: 520px; }
.fits figcaption { font-size: 14px; color: var(--soft); margin-top: 8px; } .fits strong { color: var(--ink); }
svg.fit { width: 100%; height: auto; display: block; } svg text { font-size: 12px; fill: var(--soft); text-anchor: middle; }
svg text.own { fill: var(--ink); font-weight: 700; } svg text.axis { font-size: 11px; }
.bar.other { fill: var(--area); } .bar.best { fill: var(--line); } .base { stroke: var(--rule); }
details.source { background: var(--card); border: 1px solid var(--rule); border-radius: 12px; margin: 0 0 12px; }
details.source > summary { padding: 14px 18px; display: flex; flex-wrap: wrap; gap: 2px 14px; align-items: baseline; list-style: none; }
details.source > summary::-webkit-details-marker { display: none; }
details.source > summary::before { content: "\\25B8"; color: var(--soft); } details.source[open] > summary::before { content: "\\25BE"; }
summary .name { font-weight: 600; overflow-wrap: anywhere; } .badge { font-size: 13px; font-weight: 600; }
.badge.error { color: var(--error); } .badge.warning { color: var(--warning); } .badge.note { color: var(--note);
  } .badge.good { color: var(--good); }
.inside { padding: 0 18px 18px; }
.topic { border-top: 1px solid var(--rule); padding: 12px 0; display: grid; grid-template-columns: minmax(220px, 300px) 1fr;
  gap: 4px 20px; }
.topic .title { font-weight: 600; overflow-wrap: anywhere; } .topic .facts { font-size: 13px; color: var(--soft); }
.facts b { color: var(--ink); font-weight: 600; font-variant-numeric: tabular-nums; }
.plots { min-width: 0; } svg.lane { width: 100%; height: 44px; display: block; background: var(--code); border-radius: 6px; }
svg.lane.lag { height: 26px; margin-top: 5px; } .area { fill: var(--area); } .usual { stroke: var(--soft); stroke-dasharray: 4 5;
  opacity: .6; }
.band { opacity: .62; } .band.error { fill: var(--error); } .band.warning { fill: var(--warning);
  } .band.note { fill: var(--note); opacity: .3; }
.line { fill: none; stroke: var(--line); stroke-width: 1.6; vector-effect: non-scaling-stroke; }
.scale { font-size: 12px; color: var(--soft); display: flex; justify-content: space-between; }
.sheet { display: grid; grid-template-columns: repeat(auto-fill, minmax(124px, 1fr)); gap: 8px; margin: 0; }
.sheet figure { margin: 0; } .sheet img { width: 100%; height: auto; display: block; border-radius: 6px; background: var(--code);
  image-rendering: auto; }
.sheet figcaption { font-size: 11.5px; color: var(--soft); overflow-wrap: anywhere; line-height: 1.35; margin-top: 3px; }
footer { margin-top: 56px; font-size: 13px; color: var(--soft); border-top: 1px solid var(--rule); padding-top: 14px; }
@media (max-width: 640px) { main { padding: 22px 14px 56px; } h1 { font-size: 24px; } h2 { margin-top: 36px; }
  .tally { gap: 8px; } .tally li { flex: 1 1 88px; min-width: 0; padding: 8px 12px 6px; } .tally b { font-size: 24px; }
  .finding { padding: 12px 13px; } .topic { grid-template-columns: 1fr; } .inside { padding: 0 13px 13px; }
  details.source > summary { padding: 12px 13px; } .sheet { grid-template-columns: repeat(3, 1fr); gap: 6px; } }
"""
