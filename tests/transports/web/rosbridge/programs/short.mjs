// The shortest program of roslibjs 2: one goal, and its result.
import { Action, Ros } from "roslib";

const ros = new Ros({ url: process.argv[2] });
const action = new Action({
  ros,
  name: "/fibonacci",
  actionType: "arduinobot_msgs/action/Fibonacci",
});
ros.on("connection", () => {
  action.sendGoal({ order: 0 }, (result) => {
    console.log(JSON.stringify(result));
    ros.close();
  });
});
