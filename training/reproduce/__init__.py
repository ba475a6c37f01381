"""``coloc reproduce``: a paper's experiments, its figures beside ours, and what holds.

A study is data: a plan of cells, measures, claims and goals, tables, figures (``study``). One
machine computes what its store lacks (``work``, ``pool``, ``store``, ``identity``), decides what
holds (``verdicts``), and writes the results and their page (``page``).
"""
