(function () {
  var config = {displaylogo: false, responsive: true, showSendToCloud: false,
                modeBarButtonsToRemove: ['lasso2d', 'select2d', 'autoScale2d']};
  var choice = document.getElementById('axle-box');
  var places = [];

  // Of the curves that belong to an axle box, only those of the chosen one are shown.
  function visible(traces) {
    return traces.map(function (trace) {
      var box = trace.meta && trace.meta.axle_box;
      return box && choice ? box === choice.value
        : trace.visible === undefined ? true : trace.visible;
    });
  }

  document.querySelectorAll('script.figure').forEach(function (source) {
    var figure = JSON.parse(source.textContent);
    var place = document.getElementById(source.dataset.plot);
    visible(figure.data).forEach(function (shown, i) { figure.data[i].visible = shown; });
    places.push(place);
    Plotly.newPlot(place, figure.data, figure.layout, config);
  });

  if (choice) {
    choice.addEventListener('change', function () {
      places.forEach(function (place) {
        if (place.data.some(function (trace) { return trace.meta && trace.meta.axle_box; })) {
          Plotly.restyle(place, {visible: visible(place.data)});
        }
      });
    });
  }

  // A page is narrower than a screen: draw the plots at its width, and back again afterwards.
  window.addEventListener('beforeprint', function () {
    places.forEach(function (place) { Plotly.relayout(place, {width: 690, autosize: false}); });
  });
  window.addEventListener('afterprint', function () {
    places.forEach(function (place) { Plotly.relayout(place, {width: null, autosize: true}); });
  });
}());
