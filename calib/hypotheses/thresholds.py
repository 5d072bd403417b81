"""What decides between hypotheses: each threshold once, with its source or reason.

Where neither stands, the number is a choice that nobody has measured.

What decides whether there is anything to explain belongs to the fit
(:data:`~deal_hw.calib.fit.intervals.MISMATCH_CHI2` and its neighbours).
"""

from __future__ import annotations

from typing import Final

FALSE_DISCOVERIES: Final = 0.1
"""Largest expected share of accepted hypotheses that are wrong, over all that were asked [-]. The customary
level of Benjamini and Hochberg (1995); held by e-values whatever their dependence (Wang and Ramdas 2022)."""

TEMPER: Final = 0.5
"""Power of a likelihood ratio that counts as evidence [-]. Residuals of a wrong model are no white noise, not
even one for each correlation time. Of 120 simulated joints with a slow random force, and of 120 with another
one, 26 and 22 % had a false cause of 5 at the nominal level of 10 % with a power of 1, and 7 and 6 % with
this one."""

EVIDENCE: Final = 20.0
"""Least difference in deviance that no chance makes [-]: odds of 22,000 to 1. Of two fits of the same motion
that ended in different minima, of two hypotheses, and of random errors by the likelihood of the residual that
they explain. A hypothesis that predicts unseen motion is accepted at :data:`FALSE_DISCOVERIES` instead, where
it counts how many were asked."""

NOTICED: Final = 0.03
"""Least share of the held-out squared residual that a hypothesis explains [-]. Long recordings show effects
that no owner would notice: 3 % of the square is 1.5 % of the error."""

NOTICED_CORRECTION: Final = 0.2
"""The same of a correction of the recordings [-]. It must leave only noise, so a smaller share means that
little more than noise was there before, which is no reason to doubt a recording."""

DECISIVE: Final = 0.5
"""Share explained from which other causes are asked for only after its repair [-]: it is more than all others
together."""

NEAR_CHI2: Final = 9.0
"""Largest chi2 of a fit from which a cause is named: three times the noise. Effects are computed around the
fit. Farther from the recordings it is not the robot, and what remains can look like any cause."""

FAR_CHI2: Final = 25.0
"""Chi2 above which linearised effects around a fit do not even say which hypotheses are worth a fit: five
times the noise. Local fits of three real robots have 75 to 160. On two of them another law comes first there
than around fits of predictions, and on the SO-101 it is the latter's that predicts held-out motion better."""

RIVAL: Final = 0.5
"""Least gain in deviance of a hypothesis that is fitted, over that of the best one [-]."""

BURST_PART: Final = 0.05
"""Bursts occupy at most this part of the time [-]."""

BURST_SHARE: Final = 0.4
"""Bursts hold at least this share of the squared residual [-]."""

BURST_SIZE: Final = 40.0
"""Least squared residual of a burst over the median [-]."""

BURST_LEFT: Final = 4.0
"""Chi2 that bursts may leave: twice the noise. Bursts predict nothing, and are chosen for their size, so only
what they leave can support them."""

SURE: Final = 5.0
"""Least value of a parameter that a named hypothesis has, in its standard deviations [-]. Each joint has one,
and the standard deviations are those of a part of the recordings, without kinks."""

LEAST_PLAY: Final = 0.2
"""Least play of a named joint, as a share of the widest one [-]."""

LEAST_RISE: Final = 0.01
"""Least distance of a found mass from the lower end of its range, as a share [-]."""

MASS_ALIKE: Final = 0.8
"""Least explained share of a named body's mass, relative to the best one's [-]."""

CORRECTIONS_ALIKE: Final = 1.1
"""Largest ratio of the held-out squared residual to the best one's for corrections of the recordings that are
named together [-]."""

OWN_EFFECT: Final = 0.02
"""A signature of which the parameters explain all but this share is their own effect. On 12 cart-poles the
searched inertia of the pole left 0.1 to 0.8 % on nine, 1.8 to 7 % on three; friction, loads and play left 1
to 96 %, and a servo whose damping acts late 0.6 to 28 %."""

WINDOW_S: Final = 0.2
"""Windows of fits that hypotheses are judged by [s]: the shortest of a refinement, as even a poor start does
not diverge in them."""

MOST_CAUSES: Final = 3
"""Most causes that are named by their signatures; each is judged beside those before it."""

MOST_ALARMS: Final = 2
"""Most causes of a residual that become alarms; all are in the provenance."""

MOST_LAWS: Final = 3
"""Most laws that a fit takes, one on top of the other."""

MOST_FOLDED: Final = 2
"""Most laws that are fitted in the folds. A law is often about as good as another one: play and friction that
falls with speed both delay a joint that turns round."""
