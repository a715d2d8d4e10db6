// A page of one chart.
"use strict";
modetune.chart(document.getElementById("chart"), JSON.parse(document.getElementById("data").textContent));
