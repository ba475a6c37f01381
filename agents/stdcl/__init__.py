"""The spatio-temporal graph network of ST-DCL (paper, section 4.2), which corrects the optimizer.

Dimensionless scalars gate *vectors* in metres: residuals along links, innovations, displacements of
neighbours. So corrections are equivariant to rotations and reflections, invariant to translations,
and transfer to teams of other sizes and scales.

The paper's displayed equations are lost in the text that we have. It names 28 (attention) and 36
(feedback); the numbers between are counted by the order of the text.
"""
