"""The look and the behaviour of a report page: its style sheet and its script, both put into the page itself."""

from __future__ import annotations

# Colours that stay apart for colour-blind readers, one set for each ground.
STYLE = """
:root{color-scheme:light dark;--ground:#fbfaf8;--card:#fff;--ink:#1d2126;--soft:#626a73;--rule:#e3e0da;
--line-1:#0b6bb3;--line-2:#c8551b;--line-3:#0a8561;--line-4:#8a4fa3;--well:#0a7d57;--ill:#b3431a;--shade:#8883;--band:#0b6bb314}
@media(prefers-color-scheme:dark){:root{--ground:#14171a;--card:#1c2024;--ink:#e8e6e2;--soft:#9aa3ac;--rule:#30363c;
--line-1:#5fb3f0;--line-2:#f19a5b;--line-3:#4fcfa5;--line-4:#cf9be6;--well:#52d0a2;--ill:#f39a6c;--band:#5fb3f01a}}
*{box-sizing:border-box}
body{margin:0;background:var(--ground);color:var(--ink);font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,
"Noto Sans","Liberation Sans",sans-serif}
main{max-width:1180px;margin:0 auto;padding:2.2rem clamp(1rem,3vw,2.4rem) 4rem}
h1{font-size:clamp(1.9rem,5vw,2.8rem);line-height:1.1;letter-spacing:-.02em;margin:.1em 0 .35em;overflow-wrap:anywhere}
h1::first-letter{text-transform:uppercase}
h2{font-size:1.3rem;letter-spacing:-.01em;margin:3rem 0 1rem;padding-top:1rem;border-top:1px solid var(--rule)}
.from{color:var(--soft);margin:0;overflow-wrap:anywhere}
.verdict{font-size:1.16rem;max-width:46em;margin:0 0 1.4rem;padding-left:.8rem;border-left:4px solid var(--well)}
.verdict.ill{border-color:var(--ill)}
dl{display:grid;grid-template-columns:repeat(auto-fill,minmax(8.1rem,1fr));gap:1px;margin:0;background:var(--card);
border:1px solid var(--rule);border-radius:10px;overflow:hidden}
dl div{box-shadow:0 0 0 1px var(--rule);padding:.7rem .9rem;display:flex;flex-direction:column-reverse;
justify-content:flex-end}
dt{color:var(--soft);font-size:.84rem}
dd{margin:0;font-size:1.4rem;font-weight:600;letter-spacing:-.03em;white-space:nowrap;font-variant-numeric:tabular-nums}
figure{margin:0;min-width:0}
figcaption{color:var(--soft);font-size:.9rem;margin-top:.4rem}
.videos{display:grid;gap:1.4rem;align-items:start}
@media(min-width:900px){.videos{grid-template-columns:minmax(0,2fr) minmax(0,3fr)}}
video{width:100%;display:block;border-radius:10px;background:#000}
.plots{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,21rem),1fr));gap:1.2rem;align-items:start}
.plot{background:var(--card);border:1px solid var(--rule);border-radius:10px;padding:.8rem .7rem .5rem}
.plot figcaption{margin:0 .2rem .4rem;line-height:1.4;min-height:2.8em}
.plot b{color:var(--ink);font-weight:600}
.plot b::first-letter{text-transform:uppercase}
.plot output{display:block;font-variant-numeric:tabular-nums;color:var(--ink)}
.plot output:empty{display:none}
.key{white-space:nowrap;margin-left:.7em}
.key i{display:inline-block;width:1.1em;height:3px;border-radius:2px;vertical-align:.25em;margin-right:.35em}
svg{display:block;width:100%;height:auto;touch-action:pan-y;cursor:crosshair}
svg text{font:12.5px system-ui,"Segoe UI",Roboto,"Noto Sans","Liberation Sans",sans-serif;fill:var(--soft)}
svg path{fill:none}
.grid{stroke:var(--rule)}
.mark{stroke:var(--ill);stroke-dasharray:2 4}
svg .marklabel{font-size:11.5px;paint-order:stroke;stroke:var(--card);stroke-width:3px}
.line{stroke-width:1.9;stroke-linejoin:round;stroke-linecap:round}
.hidden{fill:var(--shade)}
.band{fill:var(--band)}
.cursor{stroke:var(--ink);opacity:.55;visibility:hidden}
.finding{font-size:1.05rem;font-weight:600;margin:0 0 .6rem;color:var(--well)}
.finding.ill{color:var(--ill)}
.words{margin:0;padding-left:1.2rem;max-width:46em}
.words li{margin:.3rem 0}
.missing{margin:0;padding:.8rem 1rem;border:1px dashed var(--soft);border-radius:10px;color:var(--soft);
overflow-wrap:anywhere}
header+.missing{margin-top:1.4rem}
.command{margin:0 0 1.1rem}
.command p{margin:0 0 .3rem}
pre{position:relative;margin:0;background:var(--card);border:1px solid var(--rule);border-radius:8px;
padding:.7rem 4.6rem .7rem .9rem}
code{font:.86rem/1.55 ui-monospace,"SF Mono",Menlo,Consolas,"Liberation Mono",monospace;white-space:pre-wrap;
overflow-wrap:anywhere}
button{position:absolute;top:.45rem;right:.45rem;font:inherit;font-size:.8rem;color:var(--soft);
background:var(--ground);border:1px solid var(--rule);border-radius:6px;padding:.15rem .6rem;cursor:pointer}
button:hover,button:focus-visible{color:var(--ink);border-color:var(--soft)}
.tables{columns:2;column-gap:2.4rem}
@media(max-width:760px){.tables{columns:1}}
table{width:100%;border-collapse:collapse;font-size:.9rem;margin:0 0 1.6rem;break-inside:avoid;table-layout:fixed}
caption{text-align:left;font-weight:600;padding-bottom:.3rem}
th,td{text-align:left;vertical-align:top;padding:.28rem .5rem .28rem 0;border-top:1px solid var(--rule);
font-weight:400;overflow-wrap:anywhere}
th{width:42%;color:var(--soft)}
td{font-variant-numeric:tabular-nums}
"""

# The cursor of a plot follows the pointer and, else, the video of the same clock; a click seeks that video.
SCRIPT = """
for(const pre of document.querySelectorAll('pre')){
  const button=document.createElement('button');button.textContent='Copy';
  button.onclick=async()=>{try{await navigator.clipboard.writeText(pre.querySelector('code').textContent);
    button.textContent='Copied'}catch{button.textContent='Select it'}
    setTimeout(()=>button.textContent='Copy',1500)};
  pre.append(button)}
for(const figure of document.querySelectorAll('.plot')){
  const data=JSON.parse(figure.dataset.plot),svg=figure.querySelector('svg'),cursor=figure.querySelector('.cursor'),
    said=figure.querySelector('output'),video=document.getElementById(figure.dataset.clock),
    t=data.t,[left,right]=data.x,span=t[t.length-1]-t[0]||1;
  const show=(time,talk)=>{
    const at=Math.min(Math.max(time,t[0]),t[t.length-1]);
    let k=t.findIndex(v=>v>=at);if(k<0)k=t.length-1;
    cursor.style.visibility='visible';
    cursor.setAttribute('transform','translate('+(left+(at-t[0])/span*(right-left))+' 0)');
    said.textContent=talk?at.toFixed(2)+' s: '+data.names.map((n,i)=>n+' '+
      (data.values[i][k]??'–')).join(', ')+' '+(data.unit.includes(' ')?'':data.unit):''};
  const timeOf=e=>{const box=svg.getBoundingClientRect(),x=(e.clientX-box.left)/box.width*svg.viewBox.baseVal.width;
    return t[0]+(x-left)/(right-left)*span};
  let held=false;
  svg.onpointermove=e=>{held=true;show(timeOf(e),true)};
  svg.onpointerleave=()=>{held=false;said.textContent='';if(!video)cursor.style.visibility='hidden'};
  if(video){svg.onclick=e=>{video.currentTime=Math.max(0,timeOf(e))};
    const follow=()=>{if(!held&&(video.currentTime>0||!video.paused))show(video.currentTime,false)};
    video.addEventListener('timeupdate',follow);video.addEventListener('seeked',follow)}}
"""
