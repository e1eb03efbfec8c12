"use strict";
{
  const rows = JSON.parse(document.getElementById("cameras").textContent);
  const slider = document.getElementById("magnification-slider");
  const set = (id, text) => { document.getElementById(id).textContent = text; };
  const show = () => {
    const row = rows[Number(slider.value)];
    set("magnification-shown", row.title + (row.calibrated ? ", calibrated here" : ""));
    slider.setAttribute("aria-valuetext", row.title);
    row.values.forEach((pair, k) => set(`camera-value-${k}`, pair[1]));
    row.K.forEach((line, i) => line.forEach((value, j) => set(`camera-k-${i}-${j}`, value)));
  };
  slider.addEventListener("input", show);
  slider.hidden = false;
  show();
}
