// A program of roslibjs 2 that watches the goals of another client by topics.
import { Action, Ros, Topic } from "roslib";

const [url] = process.argv.slice(2);
const connected = async () => {
  const ros = new Ros({ url });
  await new Promise((resolve, reject) => {
    ros.on("connection", resolve);
    ros.on("error", reject);
  });
  return ros;
};
const watcher = await connected();
const sender = await connected();
const { topics, types } = await new Promise((resolve) => watcher.getTopics(resolve));
const feedback = new Topic({ ros: watcher, name: topics[0], messageType: types[0] });
const status = new Topic({ ros: watcher, name: topics[1], messageType: types[1] });
const heard = [];
const told = new Promise((resolve) => {
  feedback.subscribe((message) => {
    if (heard.push(message.feedback) === 2) resolve();
  });
});
let begun;
const hasBegun = new Promise((resolve) => (begun = resolve));
const succeeded = new Promise((resolve) => {
  status.subscribe((message) => {
    begun();
    if (message.status_list.some((one) => one.status === 4)) resolve();
  });
});
await hasBegun;
const action = new Action({ ros: sender, name: "/fibonacci", actionType: "arduinobot_msgs/action/Fibonacci" });
action.sendGoal({ order: 3 }, () => {});
await told;
await succeeded;
feedback.unsubscribe();
status.unsubscribe();
console.log(JSON.stringify([topics, types, heard]));
sender.close();
watcher.close();
