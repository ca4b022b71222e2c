<%doc>Report of a campaign or of an analysis, as a page of HTML.</%doc>\
<!doctype html><html lang=en><meta charset=utf-8><title>${title}</title>
<style>\
body{font-family:sans-serif;max-width:60em;margin:2em auto;font-size:14px;line-height:1.35}\
table{border-collapse:collapse;margin:1em 0}img{max-width:100%;break-inside:avoid}\
td,th{padding:.2em .7em;text-align:left;border-bottom:1px solid #ccc;vertical-align:top}.from{color:#666}\
.numbers td:nth-child(n+2):not(:last-child),.numbers th:nth-child(n+2):not(:last-child){text-align:right}\
.new{break-before:page}h2{break-after:avoid}@media print{body{font-size:11px}}\
</style>
% for number, part in enumerate(parts):
<section id=part-${number} class=${"new" if part.new_page else "same"}>\
% if part.heading:
<% level = "h2" if number else "h1" %><${level}>${part.heading}</${level}>\
% endif
% for line in part.lines:
<p>${line}</p>
% endfor
% if part.names:
<table class=${"numbers" if part.links else "texts"}><tr>\
% for name in part.names:
<th>${name}</th>\
% endfor
</tr>\
% for k, row in enumerate(part.rows):
<tr>\
% for column, cell in enumerate(row):
% if part.links and not column:
<td><a href='#part-${part.links + k}'>${cell}</a></td>\
% else:
<td>${cell}</td>\
% endif
% endfor
</tr>\
% endfor
</table>\
% endif
% if part.note:
<p class=from>${part.note}</p>
% endif
% if part.picture:
${html_image(part.picture, part.text) | n}
% endif
</section>
% endfor
</html>
