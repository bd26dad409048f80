"""Shows what value alignment does to a trained world model.

    vawm.analysis.episodes       whole episodes of a policy, recorded
    vawm.analysis.inference      the states of an episode, and imagination from each
    vawm.analysis.values         value errors by depth of imagination, actual returns
    vawm.analysis.trajectories   imagined trajectories against the truth
    vawm.analysis.saliency       what the value, the decoder and the critic depend on
    vawm.analysis.curves         losses and weights over a training, several runs together
    vawm.analysis.tables         CSV and JSON
    vawm.analysis.figures, vawm.policy.movies   pictures; they need the extra `analysis`
    vawm.analysis.program        the command line, `vawm analyse`

All other modules compute numbers.
"""
