"""The style sheet of a report's page: light and dark paper, phones, printers.

Colours of series are those of Okabe & Ito (2008), which colour-blind readers can tell apart, made
lighter on dark paper.
"""

from __future__ import annotations

__all__ = ["STYLE"]

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1c1d21; --soft: #5d6168; --line: #dcdee2;
  --panel: #f6f7f8; --real: #1c1d21; --without: #c44d00; --with: #0072b2; --part: #007a59;
  --alarm: #a3420a; }
@media (prefers-color-scheme: dark) { :root { --paper: #16181b; --ink: #e9eaec; --soft: #a3a8b0;
  --line: #34383e; --panel: #1f2226; --real: #e9eaec; --without: #f08a45; --with: #62b7ec;
  --part: #39b894; --alarm: #f2a06b; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 84rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.25rem; line-height: 1.45; font-weight: 600; margin: .4rem 0 .8rem;
  max-width: 54rem; overflow-wrap: anywhere; }
h2 { font-size: 1.1rem; margin: 0 0 .5rem; }
h3 { font-size: .95rem; margin: 1rem 0 .3rem; color: var(--soft); overflow-wrap: anywhere; }
p, li { max-width: 54rem; overflow-wrap: anywhere; }
section { border-top: 1px solid var(--line); padding: 1.2rem 0; }
header.verdict { border-left: .4rem solid var(--soft); padding: .2rem 0 .2rem 1rem;
  margin: 1rem 0; }
header.verdict > p { margin: 0; color: var(--soft); }
header.verdict > p strong { color: var(--ink); text-transform: capitalize; }
header.named, header.named_partial { border-color: var(--with); }
header.none { border-color: var(--part); }
header.ambiguous, header.unknown { border-color: var(--without); }
.alarms summary { color: var(--alarm); font-weight: 600; }
summary { cursor: pointer; padding: .3rem 0; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 20rem), 1fr));
  gap: .8rem 1.2rem; align-items: start; }
.grid.small { grid-template-columns: repeat(auto-fill, minmax(min(100%, 14rem), 1fr)); }
.grid.wide { grid-template-columns: minmax(0, 32rem); }
.grid.wide figure { max-width: none; }
figure { margin: 0; min-width: 0; max-width: 30rem; }
svg { display: block; width: 100%; height: auto; font-size: 11.5px; fill: var(--ink); }
td svg { width: 9.5rem; }
svg .title { font-weight: 600; font-size: 12px; }
svg .end { text-anchor: end; fill: var(--soft); }
svg .middle { text-anchor: middle; fill: var(--soft); }
.grid path, .line { fill: none; }
.line { stroke-width: 1.8; stroke-linejoin: round; }
.line.real { stroke: var(--real); stroke-width: 4.5; stroke-opacity: .3; }
.line.without { stroke: var(--without); stroke-dasharray: 5 3; }
.line.with { stroke: var(--with); stroke-dasharray: 2 2.5; stroke-width: 2.2; }
svg path.grid { stroke: var(--line); }
svg path.zero { stroke: var(--soft); }
.whisker { stroke: var(--ink); stroke-width: 1.2; fill: none; }
.dot.without { fill: var(--without); }
.dot.with { fill: var(--with); }
svg .band { fill: var(--soft); fill-opacity: .22; }
.bar.total { fill: var(--soft); }
.bar.parameters { fill: var(--part); }
.bar.effect { fill: var(--with); }
.bar.floor { fill: var(--line); stroke: var(--soft); }
.legend { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; margin: .3rem 0; font-size: .9rem; }
.key { display: inline-block; width: 1.6rem; margin-right: .4rem; vertical-align: .25em;
  border-top: 3px solid; }
.key.real { color: color-mix(in srgb, var(--real) 35%, transparent);
  border-top-width: 5px; }
.key.without { color: var(--without); border-top-style: dashed; }
.key.with { color: var(--with); border-top-style: dotted; }
.scroll { overflow-x: auto; margin: .5rem 0; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--soft); padding: .2rem 0; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid var(--line);
  vertical-align: middle; font-weight: 400; }
td { white-space: nowrap; }
.long { white-space: normal; display: inline-block; max-width: min(50rem, 62vw);
  overflow-wrap: anywhere; }
thead th { color: var(--soft); vertical-align: bottom; }
tbody th { overflow-wrap: anywhere; min-width: 6rem; }
.grid table { width: 100%; }
.share { position: relative; display: inline-block; min-width: 7rem; height: 1.3em; }
.share b { position: relative; font-weight: 400; padding-left: .3rem; }
.share .fill { position: absolute; inset: 0 auto 0 0; background: var(--with); opacity: .28; }
.heat { display: inline-block; min-width: 3.4rem; padding: .1rem .4rem; text-align: right;
  background: color-mix(in srgb, var(--without) calc(var(--share) * .6), transparent); }
.status { white-space: nowrap; }
.status.named { color: var(--with); font-weight: 600; }
.status.rejected, .status.confounded { color: var(--without); }
code { font-size: .95em; background: var(--panel); padding: .05rem .3rem; }
@media (max-width: 40rem) { main { padding: .6rem; } th, td { padding-right: .6rem; } }
@media print { section, figure, tr { break-inside: avoid; } .scroll { overflow: visible; }
  section { break-inside: auto; } h2, h3 { break-after: avoid; } table { font-size: .7rem; }
  details::details-content { content-visibility: visible; block-size: auto; }
  * { print-color-adjust: exact; } }
"""
