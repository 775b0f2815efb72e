// Order of the results of a search: pages that explain come before the reference of the modules.
// Sphinx puts this in front of its search. The numbers are its own, but for `score`.
var Scorer = {
  score: function (result) {
    const docname = result[0];
    const score = result[4];
    const explains = !docname.startsWith("reference/");
    const teaches = docname.startsWith("guide/") || docname.startsWith("notebooks/");
    return score + (explains ? 1000 : 0) + (teaches ? 1000 : 0);
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
