<%doc>The page: all that is the same for everybody. Answers and pictures come later.</%doc>
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="description" content="Would the Mauve satellite see this stellar flare, and how sure can one be?">
<meta name="color-scheme" content="light dark">
<title>mauvecl: would Mauve see this flare?</title>
<link rel="icon" type="image/svg+xml" href="favicon.svg">
<link rel="stylesheet" href="assets/page.css?v=${digest}">
<script src="assets/theme.js?v=${digest}"></script>
<script defer src="assets/bokeh.min.js?v=${digest}"></script>
<script type="module" src="assets/page.js?v=${digest}"></script>
<script type="application/json" id="words">${words | n}</script>
</head>
<body>
<%def name="help(name, about)">\
<button type="button" class="help" popovertarget="help-${name}" aria-label="What is ${about}?">?</button>\
</%def>
<%def name="meaning(name, about, message)">
<div class="meaning" id="help-${name}" popover><strong>${about}</strong> ${message}</div>
</%def>
<%def name="upload(name, title, about, kinds)">
<div class="file"><button type="button" class="plain" data-choose="${name}">${title}</button>
<input type="file" data-upload="${name}" aria-label="${about}" tabindex="-1" hidden><span class="hint">${kinds}</span>
<span data-uploaded="${name}"></span>
% if fields.FIELDS[name].kind == "file":
<button type="button" class="plain" data-remove="${name}" hidden>Remove it</button>
% endif
<span data-remedies="${name}"></span></div>
% if name in fields.WITH_FILE:
<div class="options">
% for option in fields.WITH_FILE[name]:
${control(option)}
% endfor
</div>
% endif
</%def>
<%def name="control(name)">
<% field = fields.FIELDS[name] %>
<div class="field" data-field="${name}">
<div class="head"><label for="f-${name}">${field.label}</label>${help(name, field.label)}${meaning(name, field.label, field.hint)}</div>
% if name == "star":
<div class="combo">
<input id="f-star" name="star" type="text" role="combobox" autocomplete="off" spellcheck="false" value="${field.first}"
 aria-expanded="false" aria-controls="stars" aria-autocomplete="list" aria-describedby="w-star">
<ul id="stars" role="listbox" aria-label="Stars" hidden></ul>
</div>
<p class="known"><span id="k-star"></span> <button type="button" class="plain" id="o-star" hidden></button></p>
${upload("star", "Use your own spectrum", "Your own spectrum", "text, ECSV, VOTable or FITS; or drop it here")}
% elif name == "own_unknown":
<input id="f-own_unknown" name="own_unknown" type="text" autocomplete="off" spellcheck="false" placeholder="${field.placeholder}" aria-describedby="w-own_unknown">
${upload("own_unknown", "Use a file of nm and DN", "File of the unknown spectrum", "")}
% elif field.kind == "file":
<input id="f-${name}" name="${name}" type="text" aria-label="${field.label}" hidden>
${upload(name, "Use a file", field.label, "text, ECSV, VOTable or FITS; or drop it here")}
% elif field.kind == "targets":
<textarea id="f-targets" name="targets" hidden></textarea>
<div class="wide" tabindex="0" role="region" aria-label="Table of targets"><table id="targets"><caption class="quiet">Targets</caption><thead><tr></tr></thead><tbody></tbody></table></div>
<div class="row"><button type="button" class="plain" id="targets-example">Three flare stars, as an example</button>
<button type="button" class="plain" id="targets-open">Open a CSV table</button><input type="file" id="targets-file" accept=".csv,.ecsv,.txt" aria-label="CSV table of targets" tabindex="-1" hidden>
<button type="button" class="plain" id="targets-clear" hidden>Remove all</button>
<p class="wrong" id="w-targets" hidden></p><span class="hint">Type names or paste a list or table; what is known of a star stands in grey and can be overwritten.</span></div>
% elif field.kind == "table":
<textarea id="f-${name}" name="${name}" rows="3" spellcheck="false" placeholder="${field.placeholder}" aria-describedby="w-${name}"></textarea>
<div class="file"><button type="button" class="plain" data-open-text="${name}">Open a CSV table</button><input type="file" data-text="${name}" accept=".csv,.txt" aria-label="CSV table: ${field.label}" tabindex="-1" hidden></div>
% elif field.kind == "upload":
<input id="f-${name}" name="${name}" type="hidden" value="">
<div class="file"><button type="button" data-choose="${name}" aria-describedby="w-${name}">Choose a file</button>
<input type="file" data-upload="${name}" aria-label="${field.label}" tabindex="-1" hidden><span class="hint">or drop it here, at most ${uploads[name].most // 2**20} MiB</span>
<span data-uploaded="${name}"></span> <span data-remedies="${name}"></span> <button type="button" class="plain" data-remove="${name}" hidden>Remove</button></div>
% if name in examples:
<% asset, about = examples[name] %>
<div class="file"><button type="button" data-example="${name}" data-asset="${asset}">Try an example file</button><span class="hint">${about}</span></div>
% endif
% elif field.kind == "day":
<input id="f-${name}" name="${name}" type="date" value="${field.first}" aria-describedby="w-${name}">
% elif hasattr(field.read, "options"):
<select id="f-${name}" name="${name}" aria-describedby="w-${name}">
% for option in field.read.options:
<option value="${option}"${" selected" if option == field.first else ""}>${spoken(name, option)}</option>
% endfor
</select>
% if name == "realisations":
<p class="known" id="n-realisations"></p>
% endif
% else:
<div class="number"><input id="f-${name}" name="${name}" type="text" value="${field.first}" placeholder="${field.placeholder}" autocomplete="off" spellcheck="false"
 ${"inputmode=decimal" if hasattr(field.read, "range") else "list=names" if name == "target" else "list=library" if field.kind == "library" else f"list=s-{name}" if field.suggestions else ""} aria-describedby="w-${name}">
% if name == "magnitude":
<label class="aside" for="f-band">in</label>
<select id="f-band" name="band" aria-describedby="w-band">
% for option in fields.FIELDS["band"].read.options:
<option${" selected" if option == fields.FIELDS["band"].first else ""}>${option}</option>
% endfor
</select>
% elif field.unit:
<span class="unit">${field.unit}</span>
% endif
</div>
% if field.suggestions:
<datalist id="s-${name}">
% for text in field.suggestions:
<option value="${text}"></option>
% endfor
</datalist>
% endif
% if field.slider:
<input type="range" data-slider="${name}" aria-label="${field.label}, slider" min="0" max="1" step="1">
% endif
% endif
% if field.kind != "targets":
<p class="wrong" id="w-${name}" hidden></p>
% endif
% if name == "magnitude":
<p class="wrong" id="w-band" hidden></p>
% endif
</div>
</%def>
<%def name="actions(tab)">
<div class="row">
% for kind, title in tab.simulations.items():
% if kind != "detection":
<button type="button" data-simulate="${kind}" class="main" aria-disabled="true">${title}</button>
% endif
% endfor
% if any(p for p in tab.pictures if p.name in ("excess", "recorded", "telescope", "snr", "budget")):
<label><input type="checkbox" data-marks="marks" checked> spectral lines</label>
<label><input type="checkbox" data-marks="more marks"> H alpha</label>
% endif
</div>
</%def>
<%def name="spoken(name, option)"><%
if name == "realisations":
    count, _, tails = option.partition(" ")
    option = f"{int(count):,}" + (", sampled tails" if tails else "")
elif name == "signal":
    option = {"net": "the star (net)", "paper": "star and sky (paper)"}[option]
%>${option}</%def>
<noscript><p class="noscript">This page needs JavaScript. Without it, the command line gives the same answers: mauvecl detect --star G2V --magnitude 8.5.</p></noscript>
<p id="zoom-keys" hidden>Keys: plus and minus zoom, arrows move, 0 resets.</p>
<a class="skip" href="#answer">To the answer</a>
<header>
<h1>mauvecl</h1>
<p class="lead">Would the Mauve satellite see this flare?</p>
<nav aria-label="About">
<button type="button" class="plain" id="theme" aria-label="Colours: as the system has them">◐</button>
<button type="button" class="plain" data-opens="about">About and citation</button>
</nav>
</header>
<main>
<section id="asked" aria-labelledby="asked-head">
<h2 id="asked-head" class="quiet">Question</h2>
<details id="controls" open>
<summary class="fold">Change the question</summary>
<form autocomplete="off">
<div class="field" id="begin"><div class="head"><label for="preset">Begin with</label></div>
<select id="preset"><option value="">choose an example</option>
% for name in fields.PRESETS:
<option>${name}</option>
% endfor
</select></div>
% for name in fields.ASKED:
% if name != "band":
${control(name)}
% endif
% endfor
<details id="advanced"><summary>Advanced</summary>
% for title, names in fields.ADVANCED.items():
<fieldset><legend>${title}</legend>
% for name in names:
${control(name)}
% endfor
</fieldset>
% endfor
</details>
</form>
</details>
<div class="row">
<button type="button" id="pin">Pin</button>
<button type="button" data-opens="export">Share, export, cite</button>
<button type="button" class="plain" id="afresh">Start afresh</button>
</div>
</section>
<section id="answer" aria-labelledby="answer-head" tabindex="-1">
<h2 id="answer-head" class="quiet">Answer</h2>
<div id="card" class="card" aria-busy="true">
<p class="words" id="words-of" aria-live="polite">the answer is on its way</p>
<div class="message" aria-live="polite" aria-atomic="true">
<p class="chance" id="no-answer" hidden>No answer.</p>
<div id="numbers" role="group" aria-label="Chance to detect the flare">
% for choice, title in titles.items():
<button type="button" class="odds" data-unknown="${choice}" aria-pressed="${"true" if choice == fields.FIELDS["unknown"].first else "false"}" title="Show the pictures and tables of this">
<span class="chance"${' id=chance' if loop.first else ""}>…</span>
<span class="title">${title}</span>
<span class="interval"></span>
</button>
% endfor
</div>
</div>
<div class="rest">
<div class="below">
<div class="solve">
% for name in fields.SOLVED:
${control(name)}
% endfor
<p><output id="solved" for="f-of"></output> <span id="payloads" class="hint"></span></p>
</div>
</div>
<dl id="facts"></dl>
<div class="row run">
<button type="button" id="simulate" class="main" aria-disabled="true">Simulate</button>
<span id="standing"><button type="button" id="cancel" disabled>Cancel</button>
<progress id="progress" class="idle" max="1" value="0" aria-label="Simulation"></progress>
<span id="status" role="status"></span></span>
</div>
</div>
</div>
<ul id="notices" aria-label="Notices"></ul>
<datalist id="library">
% for name in library:
<option value="${name}"></option>
% endfor
</datalist>
<datalist id="names">
% for name in names:
<option value="${name}"></option>
% endfor
</datalist>
% for form, names in fields.FORMS.items():
<div class="form" id="${form}" data-form="${names[0]}" hidden>
% for name in names:
${control(name)}
% endfor
% if form == "frames":
<fieldset id="columns" hidden><legend>Which column is what?</legend>
<div class="row">
% for key, label in mapped.items():
<span class="row"><label for="m-${key}">${label}</label>
<select id="m-${key}" name="${key}" data-columns${" required" if loop.index < 2 else ""}><option value="">${"choose" if loop.index < 2 else "none"}</option></select>
% if key == "time":
<select name="time_unit" aria-label="Unit of time"><option value="">in the file's unit</option>
% for unit in time_units:
<option>${unit}</option>
% endfor
</select>
% endif
</span>
% endfor
</div></fieldset>
% endif
</div>
% endfor
<div class="tabs">
<% first = next(iter(tabs)) %>
<div role="tablist" aria-label="Pictures of the answer">
% for group, heading in groups.items():
<div role="none">
<span id="group-${group}" aria-hidden="true">${heading}</span>
% for tab in tabs.values():
% if tab.group == group:
<button type="button" role="tab" id="tab-${tab.name}" aria-controls="panel-${tab.name}" aria-describedby="group-${group}" aria-selected="${"true" if tab.name == first else "false"}" tabindex="${0 if tab.name == first else -1}" data-title="${tab.title}">${tab.title}</button>
% endif
% endfor
</div>
% endfor
</div>
% for tab in tabs.values():
<div role="tabpanel" id="panel-${tab.name}" aria-labelledby="tab-${tab.name}"${"" if tab.name == first else " hidden"}>
<p class="about">${tab.about}</p>
<% has_form = any(names[0] in tab.reads for names in fields.FORMS.values()) %>
% if has_form:
${actions(tab)}
% endif
% if any(p.pins for p in tab.pictures):
<div class="pins" hidden><label><input type="checkbox" data-marks="pins" checked> Pinned</label></div>
% endif
<div class="pictures${" one" if len(tab.pictures) == 1 else ""}">
% for picture in tab.pictures:
<figure id="figure-${picture.name}" data-picture="${picture.name}">
<h3>${picture.title}</h3>
<ul class="legend" aria-label="Colours of ${picture.title}"></ul>
<div class="plot" id="plot-${picture.name}" role="img" tabindex="0" aria-label="${picture.title}" aria-describedby="text-${picture.name} zoom-keys"></div>
<figcaption><p id="text-${picture.name}">Not drawn yet.</p>
<div class="tools">
% for axis in picture.logs:
<label><input type="checkbox" data-log="${axis.lower()}"${" checked" if axis.isupper() else ""}> log ${axis.lower()}</label>
% endfor
% for tag, title in picture.shows.items():
<label><input type="checkbox" data-show="${tag}"> ${title}</label>
% endfor
<button type="button" class="plain" data-reset>Reset zoom</button>
<span>Save picture:</span>
% for ending in ("svg", "png", "pdf"):
<button type="button" class="plain" data-save="${ending}">${ending.upper()}</button>
% endfor
% if picture.sets:
<span>A click sets ${" and ".join("the " + fields.FIELDS[part.split("=")[0]].label.lower() for part in picture.sets.split(","))}.</span>
% endif
</div>
<details class="data"><summary>Data as a table</summary><div class="wide" tabindex="0" role="region" aria-label="Data of ${picture.title}"></div></details>
</figcaption>
</figure>
% endfor
</div>
% if tab.name == "compare":
<h3>Pinned</h3>
<div class="wide" id="pinned" tabindex="0" role="region" aria-label="Pinned scenarios"><p>Nothing is pinned yet: Pin keeps the present question and its answer here.</p></div>
<h3>History</h3>
<ol id="history" reversed></ol>
<p id="no-history">Nothing is simulated yet.</p>
% else:
% if not has_form:
${actions(tab)}
% endif
% if tab.pictures:
<p class="hint">To zoom: drag a box, pinch, or turn the wheel with Ctrl or after a click. Keys: + − arrows 0.</p>
% endif
<div class="wide rows" tabindex="0" role="region" aria-label="Table of ${tab.title}" hidden></div>
% if tab.files:
<div class="row files"><span>Tables:</span>
% for name in tab.files:
<button type="button" data-file="${name}" data-ending="ecsv" disabled>${name} (ecsv)</button>
<button type="button" data-file="${name}" data-ending="fits" disabled>${name} (fits)</button>
% if name in tab.simulations and name != "detection":
<button type="button" data-file="${name}" data-ending="study" disabled>${name} (study)</button>
% endif
% endfor
% for name in tab.documents:
<button type="button" data-file="${name}" data-ending="" disabled>${name}</button>
% endfor
% if any(tab.files.values()):
<span class="hint" data-needs="${" ".join(dict.fromkeys(filter(None, tab.files.values())))}"></span>
% endif
</div>
% endif
% endif
</div>
% endfor
</div>
</section>
</main>
<footer><p id="nominal">Nominal throughput, pieced together from the paper, datasheets and assumptions: not a flight calibration. Sensible uncertainty: 30 %, and 50 % below 250 nm.</p></footer>
<dialog id="export" aria-labelledby="export-head">
<h2 id="export-head">Share, export, cite</h2>
<p>What this tab shows after its simulation: the same numbers, to the bit, wherever mauvecl runs.</p>
<p class="row"><label for="of">Answer of</label> <select id="of"></select></p>
<div class="row"><button type="button" class="main" id="study">Study for the command line</button><button type="button" data-copy="address">Copy the link</button></div>
<p class="wrong" id="link-lacks" hidden>The link does not hold your file: who opens it needs the file, too. The study holds it.</p>
<h3>Command line</h3><pre id="as-command" tabindex="0"></pre><button type="button" data-copy="as-command">Copy the command</button>
<h3>Python</h3><pre id="as-python" tabindex="0"></pre><button type="button" data-copy="as-python">Copy the program</button>
<%doc>As in the project's file CITATION.cff, which has neither the paper's volume and pages nor an address of the project.</%doc>\
<h3>Citation</h3><pre id="as-bibtex" tabindex="0">@software{mauvecl,
  author = {{The mauvecl developers}},
  title = {mauvecl: would the Mauve satellite see this stellar flare?},
  version = {${version}},
  year = {2026}
}

@article{mauvesim,
  author = {Saba, A. and Favata, F. and Savini, G. and Tinetti, G. and Bradley, L. and Stotesbury, I. and
            Tessenyi, M.},
  title = {MauveSim: the instrument simulator software for the Blue Skies Space Mauve satellite},
  journal = {RAS Techniques and Instruments},
  year = {2025},
  eprint = {2502.01389},
  archivePrefix = {arXiv},
  url = {https://arxiv.org/abs/2502.01389}
}
</pre><button type="button" data-copy="as-bibtex">Copy the BibTeX</button>
<div class="row"><button type="button" data-closes>Close</button></div>
</dialog>
<dialog id="about" aria-labelledby="about-head">
<h2 id="about-head">About mauvecl ${version}</h2>
<p>Closed forms follow every change at once; Simulate refines them with noise realisations. Everything on the page can be exported, and gives the same numbers on the command line.</p>
<h3>Documentation</h3><p>The folder <code>docs</code> of the project, its page <code>docs/page.md</code> on this page, and <code>mauvecl --help</code>.</p>
<h3>Citation</h3><p>Please cite mauvecl ${version} (The mauvecl developers: “mauvecl: would the Mauve satellite see this stellar flare?”) and the paper whose instrument model it implements: Saba, A., et al., “MauveSim: the instrument simulator software for the Blue Skies Space Mauve satellite”, RAS Techniques and Instruments. The file <code>CITATION.cff</code> has both.</p>
<div class="row"><button type="button" data-closes>Close</button></div>
</dialog>
<div id="lost" role="alertdialog" aria-labelledby="lost-message" hidden><div><p id="lost-message"></p><button type="button" class="main" id="go-on" hidden>Go on</button></div></div>
</body>
</html>
