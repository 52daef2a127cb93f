"""Style sheet of a report: light and dark colours, print, and small screens."""

STYLE = """
:root {
  --paper: #f6f7f9; --card: #ffffff; --ink: #1c2430; --quiet: #5d6878; --line: #dde2ea;
  --ours: #2463c8; --theirs: #c26a00; --failed: #c2182c; --broken: #8a5a9e; --good: #1f8a56;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #12161c; --card: #1b212a; --ink: #e6eaf0; --quiet: #9aa6b6; --line: #323b48;
    --ours: #78aaff; --theirs: #ffb454; --failed: #ff7080; --broken: #c79adb; --good: #4cc38a;
  }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 26px; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 28px 0 10px; overflow-wrap: anywhere; }
h3 { font-size: 14px; margin: 8px 0 2px; overflow-wrap: anywhere; }
p { margin: 4px 0; overflow-wrap: anywhere; }
code { font: 13px ui-monospace, monospace; }
.quiet, .item p { color: var(--quiet); font-size: 13px; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 14px 16px; }
.card h2 { margin: 0 0 6px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(170px, 1fr)); gap: 12px; margin: 18px 0; }
.tile { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 12px 16px; }
.tile b { display: block; font-size: 25px; font-weight: 650; }
.tile span { color: var(--quiet); font-size: 13px; }
.bar { display: flex; height: 12px; gap: 2px; border-radius: 6px; overflow: hidden; }
.bar i { min-width: 3px; }
.good { background: var(--good); } .bad { background: var(--failed); } .broken { background: var(--broken); }
.pair { display: grid; gap: 16px; margin: 24px 0; }
.pair { grid-template-columns: repeat(auto-fit, minmax(min(480px, 100%), 1fr)); }
.gallery { display: grid; gap: 14px; margin-bottom: 18px; }
.gallery { grid-template-columns: repeat(auto-fill, minmax(270px, 1fr)); }
.item { padding: 10px 12px; }
.item img, .nothing { display: block; height: 150px; width: 100%; border-radius: 6px; }
.item img { background: #ffffff; object-fit: contain; }
.nothing { display: grid; place-items: center; border: 1px dashed var(--line); color: var(--quiet); font-size: 13px; }
.item p.why { color: var(--failed); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; margin: 8px 0; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 5px 10px; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { color: var(--quiet); font-size: 13px; font-weight: 500; }
th:first-child, td:first-child, th:last-child:nth-child(4), td:last-child:nth-child(4) {
  text-align: left; white-space: normal; overflow-wrap: anywhere; min-width: 120px;
}
tr.sum td { font-weight: 650; }
.legend { display: flex; gap: 18px; font-size: 13px; color: var(--quiet); }
.legend i { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 6px; }
.legend .ours { background: var(--ours); } .legend .theirs { background: var(--theirs); }
.legend .failed { background: var(--failed); }
svg { display: block; width: 100%; height: auto; margin: 4px 0; }
svg text { font-family: inherit !important; }
@media print { body { background: #ffffff; } .card, .tile { break-inside: avoid; } }
"""
