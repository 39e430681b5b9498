"""How to read each picture of a stability analysis, a paragraph each."""

LATENCY = (
    "Across: by how much every command comes later than planned. Upwards: the factor on all gains at which the loop"
    " becomes unstable, a curve for each operating point; the dashed line at 1 stands for the gains of the "
    "scenario. In the blue area the loop is stable at all of them. A curve that begins below the dashed line "
    "belongs to a point where the loop is unstable as it is. Filled marks: the delay margin, where a curve falls "
    "through the line. Hollow marks: the jitter margin, up to which the delay may even vary from command to "
    "command. To do: where the latency you expect lies to the right of a mark, multiply all gains by less than the "
    "height of the lowest curve at that latency. A step in a curve is a SYNC missed. Where gravity compensation "
    "comes late, gains far below a curve may be too weak to hold an upright arm; the verdict says so if these are."
)
PERIOD = (
    "The same factor on all gains, over the control period; latencies and filters stay as they are. The dotted line"
    " is the period of the scenario, the dashed line its gains; in the blue area the loop is stable at all "
    "operating points. What to look for: where the lowest curve crosses the dashed line is the longest period that "
    "these gains bear. If the curves hardly rise to the left, a faster bus will not help: the speed filter or the "
    "latency is to blame, or the gravity compensation."
)
POLES = (
    "Each mark is an eigenvalue z of the loop over one control period: a disturbance along it is multiplied by z "
    "each time. Inside the circle it dies out, the faster the nearer to the centre; outside it grows. The angle "
    "from the right is the frequency, written along the circle. The right panel enlarges the grey square around "
    "those that swing and die out last. What to look for: marks that swing and lie near the circle are what shakes "
    "the arm when gains or delays grow. Those on the line from 0 to 1, close to 1, are the slow way of the arm to "
    "its goal and no danger."
)
MODES = (
    "A panel for each operating point: how much each joint swings, compared with the one that swings most (orange),"
    " when all gains are just at their limit, and how fast. Where there is no limit it is the slowest-dying motion "
    "as it is. What to do: it is the gains of the tall bars, and the delay on these joints, that matter; lowering "
    "the gains of the others alone will not calm the arm. A frequency of a tenth or so of the sampling rate is the "
    "mark of a loop that the bus makes unstable."
)
MOTION = (
    "Above: the factor on all gains at which the loop becomes unstable in the pose that the arm has at that time; "
    "below the dashed line it is unstable already; where there is none, no line is drawn. Below: by how much the "
    "slowest-dying disturbance is multiplied from tick to tick; above 1 it grows. {how}{cycle} What to look for: "
    "stretches outside the blue. A short one may pass before anything is seen, in a long one the arm shakes. The "
    "dash-dotted line marks the worst instant; its pose, in motion.csv, is the one to tune for."
)
STEPS = (
    "The desired motion jumps from goal to goal, so the arm is looked at as if at rest on the path that it takes "
    "without the bus."
)
FROZEN = "The loop is frozen at each instant, which is right where the arm moves little while a disturbance dies out."
CYCLE = " This motion repeats; over a whole cycle a disturbance changes by the factor {factor:.4f} a period."
MAP = (
    "Joints {a} and {b} go through their ranges (joint {b} on one side of zero), the others stand as at the first "
    "operating point of the scenario; the arm is at rest in each pose. It is drawn {place}. Left: the factor on all"
    " gains at which the loop becomes unstable; blue is reserve, red is unstable, the black line, if there is one, "
    "is the border (where gains are too weak rather than too strong, the red shows by how much). Right: which joint"
    " swings most at that limit. Filled circles are operating points that lie on the map. Hollow ones have the tool"
    " there with other joints standing differently, so the colours do not hold for them. What to do: keep the work "
    "in the blue, or choose gains for the reddest pose that the task visits."
)
