"""Hand the arm under law (3) to Brax's own training code: a policy that moves the references, learnt by random search.

The environment is Brax's `PipelineEnv`; the reward of a step is its share of -cost (5).
"""

from brax.training.agents.ars import train as ars

from contact_reach_ros.planning.brax_env import ContactReach

returns: list[float] = []
ars.train(
    ContactReach("ball"),
    num_timesteps=30_000,
    episode_length=20,
    number_of_directions=25,
    top_directions=25,
    step_size=0.5,
    exploration_noise_std=0.3,
    num_eval_envs=1,
    num_evals=30,
    progress_fn=lambda steps, metrics: returns.append(float(metrics["eval/episode_reward"])),
)
print(f"return of an episode of 2 s: {returns[0]:.2f} at first, {returns[-1]:.2f} after training")
