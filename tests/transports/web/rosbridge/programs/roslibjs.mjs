// A program of roslibjs 2, as its users write it. It prints what its callbacks get, a line each.
import { Action, Ros, Service } from "roslib";

const [url, token] = process.argv.slice(2);
const ros = new Ros({ url });
await new Promise((resolve, reject) => {
  ros.on("connection", resolve);
  ros.on("error", reject);
});
if (token) ros.authenticate(token, "", "", "", 0, "", 0);

const action = new Action({
  ros,
  name: "/fibonacci",
  actionType: "arduinobot_msgs/action/Fibonacci",
});

function send(goal, cancelAfter) {
  return new Promise((resolve) => {
    const feedback = [];
    const id = action.sendGoal(
      goal,
      (result) => resolve({ feedback, result }),
      (message) => {
        feedback.push(message);
        if (feedback.length === cancelAfter) action.cancelGoal(id);
      },
      (error) => resolve({ feedback, error: String(error) }),
    );
  });
}

const print = (value) => console.log(JSON.stringify(value));
const call = (name, request) =>
  new Promise((resolve) =>
    new Service({ ros, name, serviceType: "any" }).callService(request, resolve, (error) =>
      resolve({ error }),
    ),
  );

print(await send({ order: 3 }));
print(await send({ order: -1 }));
print(await send({ order: 6 }));
print(await send({ order: 7 }));
print(await send({ order: 50 }, 2));
print(await send({ order: "x" }));
const canceled = Promise.all([send({ order: 52 }), send({ order: 53 })]);
action.cancelAllGoals();
print((await canceled).map((end) => end.error));
print(await new Promise((resolve) => ros.getActionServers(resolve)));
print(await call("/rosapi/action_type", { action: "/fibonacci" }));
print(await call("/add_two_ints", { a: 1, b: 2 }));
ros.close();
