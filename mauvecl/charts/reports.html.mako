<%doc>Reports of a campaign and of an analysis, as pages of HTML.</%doc>\
<%def name="top(title, heading)">\
<!doctype html><html lang=en><meta charset=utf-8><title>${title}</title>
<style>\
body{font-family:sans-serif;max-width:60em;margin:2em auto;font-size:14px;line-height:1.35}\
table{border-collapse:collapse;margin:1em 0}img{max-width:100%;break-inside:avoid}\
td,th{padding:.2em .7em;text-align:left;border-bottom:1px solid #ccc;vertical-align:top}.from{color:#666}\
.numbers td:nth-child(n+2):not(:last-child),.numbers th:nth-child(n+2):not(:last-child){text-align:right}\
section{break-before:page}h2{break-after:avoid}@media print{body{font-size:11px}}\
</style><h1>${heading}</h1>
</%def>\
<%def name="table(names, rows, kind='', link=False)">\
<table class='${kind}'><tr>\
% for name in names:
<th>${name}</th>\
% endfor
</tr>\
% for k, row in enumerate(rows):
<tr>\
% for column, cell in enumerate(row):
% if link and not column:
<td><a href='#target-${k}'>${cell}</a></td>\
% else:
<td>${cell}</td>\
% endif
% endfor
</tr>\
% endfor
</table>\
</%def>\
<%def name="plan(answer, legend, lines, pictures)">\
${top(f"Mauve: {answer.heading}", "Mauve: yields of a campaign")}\
<p>${answer.heading}; mauvecl ${version}.</p>
${table(*answer.views[0].texts(), "numbers", True)}
<p class=from>${legend}</p>
${pictures[0] | n}
% for message in answer.messages:
<p>${message}</p>
% endfor
% for k, target in enumerate(answer.planned):
<section id=target-${k}><h2>${target.name}</h2>${table(("", "", "table: column"), lines[k])}
% if target.seen_h > 0:
${pictures[k + 1] | n}
% endif
</section>
% endfor
<section><h2>What is assumed</h2><p class=from>Rows of assumptions.ecsv.</p>\
${table(answer.assumptions.colnames, answer.assumptions)}</section></html>\
</%def>\
<%def name="analysis(answer, title, sections, pictures)">\
${top(title, title)}\
<p>Analysed by mauvecl ${version}. ${answer.assumed}</p>
% for text in answer.messages:
<p>${text}</p>
% endfor
% for heading, names, cells in sections:
<h2>${heading}</h2>\
% if names:
${table(names, cells)}\
% endif

% endfor
% for text in answer.remarks:
<p>${text}</p>
% endfor
% for picture in pictures:
${picture | n}
% endfor
</html>\
</%def>
