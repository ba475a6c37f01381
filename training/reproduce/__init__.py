"""``coloc reproduce``: a paper's experiments run anew, its figures beside ours, and what holds.

General are the store of what has been computed (``store``, ``identity``), the work to be done
(``study``, ``pool``), its cost (``cost``), and how claims are decided (``verdicts``). What is one
paper's own lies in a package of its own: its numbers, its plan, its tables, figures and claims.
"""
