"""The style sheet and the script of the HTML page. Owns how it looks and what hovering does. Pure.

Without the script everything is there; it filters rows and lights up what belongs together.
"""

CSS = """\
:root{color-scheme:light}
body{margin:0;font:15px/1.45 system-ui,-apple-system,"Segoe UI",sans-serif;color:#1b2733;
background:#fff}
header,main{padding:0 1.5rem}
header{border-bottom:1px solid #c9d3df;background:#f6f8fb;padding-top:1rem;padding-bottom:.75rem}
h1{margin:0;font-size:1.5rem}
h2{margin:1.6rem 0 .3rem;font-size:1.15rem}
header p{margin:.2rem 0}
.hint{margin:.1rem 0 .6rem;color:#4d5a66}
.verdict{display:inline-block;padding:.25rem .6rem;border-radius:.4rem;border:1px solid}
.verdict.o-ok{background:#e3f4ee;border-color:#009e73}
.verdict.o-violated{background:#fbe9e7;border-color:#b3261e}
.verdict.o-unverifiable{background:#fdf3dc;border-color:#8a5a00}
td .o-ok,th .o-ok{color:#00664a;font-weight:600}
td .o-violated{color:#b3261e;font-weight:600}
td .o-unverifiable{color:#8a5a00;font-weight:600}
dl{display:flex;flex-wrap:wrap;gap:.4rem 1.6rem;margin:.6rem 0 .2rem}
dl div{display:flex;gap:.4rem}
dt{color:#4d5a66}dd{margin:0;font-weight:600}
.figure,.table{overflow:auto;border:1px solid #dde4ec;border-radius:.4rem;background:#fff}
.figure{max-height:85vh}
.figure svg{display:block}
.figure:focus-visible,.table:focus-visible,a:focus-visible,input:focus-visible{
outline:3px solid #0072b2;outline-offset:2px}
table{border-collapse:collapse;width:100%;font-size:.9rem}
th,td{padding:.35rem .6rem;text-align:left;vertical-align:top;border-bottom:1px solid #e6ebf1}
thead th{background:#f1f5fb;position:sticky;top:0}
tbody th{font-weight:600}
tbody tr:hover{background:#fff8df}
code{font:.92em ui-monospace,Menlo,Consolas,"DejaVu Sans Mono",monospace}
.state{display:inline-block;padding:.05rem .45rem;border-radius:.3rem;border:1px solid #8ea3bb;
white-space:nowrap}
.p-missing{color:#b3261e;font-weight:600;border-bottom:2px dashed #b3261e}
.p-undeclared{color:#a84b00;font-weight:600;border-bottom:2px dotted #c75b00}
a{color:#00598c}
.skip{position:absolute;left:-999px}
.skip:focus{left:1rem;top:.5rem;background:#fff;padding:.3rem .6rem}
input{font:inherit;padding:.2rem .4rem}
tr.gone{display:none}
@media print{.figure{max-height:none;overflow:visible}.filter{display:none}}
"""

SCRIPT = """\
"use strict";
(function () {
  var figures = document.querySelectorAll("svg.lc-figure");
  figures.forEach(function (figure) {
    var rows = figure.querySelectorAll("g.row");
    var columns = figure.querySelectorAll("g.column");
    function clear() {
      rows.forEach(function (row) { row.classList.remove("lit", "dim"); });
      columns.forEach(function (column) { column.classList.remove("dim"); });
    }
    columns.forEach(function (column) {
      column.addEventListener("mouseenter", function () {
        rows.forEach(function (row) {
          var mine = row.dataset.columns.split(" ").includes(column.dataset.column);
          row.classList.toggle("lit", mine);
          row.classList.toggle("dim", !mine);
        });
      });
      column.addEventListener("mouseleave", clear);
    });
    rows.forEach(function (row) {
      row.addEventListener("mouseenter", function () {
        var ends = row.dataset.columns.split(" ");
        columns.forEach(function (column) {
          column.classList.toggle("dim", !ends.includes(column.dataset.column));
        });
      });
      row.addEventListener("mouseleave", clear);
    });
  });
  var box = document.querySelector(".filter");
  var filter = document.getElementById("filter");
  box.hidden = false;
  filter.addEventListener("input", function () {
    var wanted = filter.value.trim().toLowerCase();
    document.querySelectorAll("tbody tr").forEach(function (row) {
      row.classList.toggle("gone", !row.textContent.toLowerCase().includes(wanted));
    });
    document.querySelectorAll("svg.lc-figure g.row").forEach(function (row) {
      row.classList.toggle("faint", !row.textContent.toLowerCase().includes(wanted));
    });
  });
})();
"""
